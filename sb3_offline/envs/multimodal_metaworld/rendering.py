"""Draws a table without a screen: small images to learn from, and finer ones for people."""

from __future__ import annotations

import atexit
import importlib
import os
import subprocess
import sys
import weakref
from collections.abc import Mapping
from ctypes.util import find_library
from typing import Any

import mujoco
import numpy as np

from sb3_offline.envs.multimodal_metaworld.composition import COARSE_ARM_GROUP, FINE_ARM_GROUP
from sb3_offline.envs.multimodal_metaworld.scene import TableScene

FRAME_SIZE = 64
_OVERSAMPLING = 2  # pixels drawn for each one kept, per direction: cheaper in software than multisampling, and as smooth

CAMERAS: dict[str, dict[str, Any]] = {
    "default": {"lookat": (0.08, 0.68, 0.1), "distance": 1.45, "azimuth": 170.0, "elevation": -50.0},
    "paper": {"lookat": (0.075, 0.75, 0.15), "distance": 1.75, "azimuth": 160.0, "elevation": -45.0},
}
"""
Free cameras (metres and degrees). "default" sees all objects and the hand's whole workspace from the side where the arm hides
least. "paper" is the camera of the CEBORL paper's authors.
"""

_HELP = """Rendering without a screen needs OpenGL. Install one of these (Debian and Ubuntu packages):
    apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri
    apt-get install libosmesa6
State observations (obs_type="state") without a render_mode need neither."""


def _works(backend: str) -> bool:
    """Try in another process, since PyOpenGL and MuJoCo settle on one backend and cannot go back."""
    code = f"import mujoco.{backend}; mujoco.{backend}.GLContext(8, 8).make_current()"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def _choose_backend() -> str:
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in ("egl", "osmesa", "glfw"):
        return chosen
    if not sys.platform.startswith("linux"):
        return "glfw"
    # EGL may use a GPU; OSMesa needs no driver. Only where both are installed does EGL have to be tried.
    if find_library("OSMesa") and not (find_library("EGL") and _works("egl")):
        return "osmesa"
    return "egl"


def _make_gl_context(width: int, height: int) -> Any:
    """
    :return: a current OpenGL context of the backend that MUJOCO_GL names, or else of the backend that works here
    """
    backend = _choose_backend()
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
        return context
    except Exception as error:  # each library has errors of its own, down to AttributeError for a missing file
        failure = f"{type(error).__name__}: {error}"
    # Raised outside of `except`, where the half-made context and its messages are gone, so that the help comes last.
    raise RuntimeError(f"{_HELP}\nTried {backend}: {failure}")


_open_renderers: weakref.WeakSet[SceneRenderer] = weakref.WeakSet()


def _close_all() -> None:
    for renderer in list(_open_renderers):
        renderer.close()


class SceneRenderer:
    """
    Draws one scene. It owns an OpenGL context, which `close` frees.

    :param scene: the scene to draw
    :param frame_size: width and height of the small images in pixels
    :param camera: all entries of one of `CAMERAS`
    """

    def __init__(
        self, scene: TableScene, frame_size: int = FRAME_SIZE, camera: Mapping[str, Any] = CAMERAS["default"]
    ) -> None:
        self._scene = scene
        self._closed = False
        self._frame_size = frame_size
        size = frame_size * _OVERSAMPLING
        self._gl = _make_gl_context(size, size)
        visual = scene.model.vis
        visual.quality.offsamples = 0
        visual.global_.offwidth = visual.global_.offheight = size
        self._context = mujoco.MjrContext(scene.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._drawn = mujoco.MjvScene(scene.model, maxgeom=200)
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._options = mujoco.MjvOption()
        # Sites mark goals, which the images must not show.
        self._options.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        for name, value in camera.items():
            setattr(self._camera, name, value)
        _open_renderers.add(self)
        # Registered anew with each context, to run before MuJoCo's own handler, which takes the display away at exit.
        atexit.unregister(_close_all)
        atexit.register(_close_all)

    def frame(self) -> np.ndarray:
        """
        :return: (frame_size, frame_size, 3) uint8, the image that a policy observes
        """
        return self._draw(self._frame_size, self._frame_size, fine=False)

    def draw(self, width: int, height: int) -> np.ndarray:
        """
        :param width: width in pixels
        :param height: height in pixels
        :return: (height, width, 3) uint8 of the same view, with the arm's fine meshes and shadows
        """
        return self._draw(width, height, fine=True)

    def device(self) -> str:
        """
        :return: OpenGL's name of the device or program that draws here
        """
        from OpenGL import GL  # only now: the backend has been chosen

        self._gl.make_current()
        return GL.glGetString(GL.GL_RENDERER).decode()

    def _draw(self, width: int, height: int, *, fine: bool) -> np.ndarray:
        self._gl.make_current()
        wide, high = width * _OVERSAMPLING, height * _OVERSAMPLING
        if wide > self._context.offWidth or high > self._context.offHeight:
            mujoco.mjr_resizeOffscreen(max(wide, self._context.offWidth), max(high, self._context.offHeight), self._context)
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = fine
        self._options.geomgroup[FINE_ARM_GROUP], self._options.geomgroup[COARSE_ARM_GROUP] = fine, not fine
        scene, viewport = self._scene, mujoco.MjrRect(0, 0, wide, high)
        mujoco.mjv_updateScene(
            scene.model, scene.data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._drawn
        )
        mujoco.mjr_render(viewport, self._drawn, self._context)
        pixels = np.empty((high, wide, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, viewport, self._context)
        blocks = pixels[::-1].reshape(height, _OVERSAMPLING, width, _OVERSAMPLING, 3)
        return (blocks.sum(axis=(1, 3), dtype=np.uint16) // _OVERSAMPLING**2).astype(np.uint8)

    def close(self) -> None:
        """Free the OpenGL context. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._gl.make_current()
        self._context.free()
        self._gl.free()
