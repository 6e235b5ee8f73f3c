"""The shared table: five Meta-World tasks composed into one MuJoCo model from the installed package's own assets."""

from __future__ import annotations

import copy
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from metaworld.asset_path_utils import ENV_ASSET_DIR_V3

INITIAL_HAND_POSITION = np.array([0.0, 0.6, 0.2])
"""Where the hand starts (m). The same for every task: a start of its own would give the task away."""

MOCAP_LOW = np.array([-0.6, 0.40, 0.05])
MOCAP_HIGH = np.array([0.65, 1.0, 0.5])
MOCAP_QUAT = np.array([1.0, 0.0, 1.0, 0.0])

BODY_POSITIONS = {
    "dial": (-0.06, 0.50, 0.0),
    "door": (-0.365, 0.94, 0.15),
    "drawer": (0.045, 0.88, 0.0),
    "lever": (0.26, 0.75, 0.0),
    "puck_channel": (0.555, 0.47, 0.015),
    "puck_goal": (0.555, 0.72, 0.0),
}
"""Nominal positions (m) of the movable bodies; `JITTER` keeps every pair of them apart."""

JITTER = 0.015
"""Half-width (m) of the uniform x and y noise that a reset adds to each body position."""

N_ARM_JOINTS = 9
"""Seven arm joints and two fingers come first in qpos and qvel."""

SCENE_STATE = {"joints": slice(0, 15), "hand_target": slice(15, 18), "bodies": slice(18, 30)}
"""What stands where in a scene state: qpos, the mocap position, and x and y of each of `BODY_POSITIONS`."""

FINE_ARM_GROUP = 2
"""Geom group of the arm's own meshes: MuJoCo draws groups 0 to 2 unless told otherwise."""

COARSE_ARM_GROUP = 3
"""Geom group of their coarse twins, for small frames."""

_COARSE_CELL = 0.015  # metres; a pixel of a 64-pixel frame covers about 25 mm
_SETTLE_STEPS = 500

_DEPENDENCIES = ("puck_goal", "dial", "doorlock", "drawer", "lever", "xyz_base")
# The puck comes first: stock plate-slide writes its slide joints as qpos[9:11].
_OBJECT_FILES = {
    "puck_channel": "puck.xml",
    "puck_goal": "puck_goal.xml",
    "dial": "dial.xml",
    "door": "doorlockB.xml",
    "drawer": "drawer.xml",
    "lever": "lever.xml",
}


def _object_path(name: str) -> str:
    folder = ENV_ASSET_DIR_V3 / "objects"
    inner = folder / "assets" / name
    return str(inner if inner.exists() else folder / name)


def _scene_xml() -> str:
    assets = ENV_ASSET_DIR_V3
    includes = [f'<include file="{assets / "scene" / "basic_scene.xml"}"/>']
    includes += [f'<include file="{assets / "objects" / "assets" / f"{name}_dependencies.xml"}"/>' for name in _DEPENDENCIES]
    bodies = [f'<body name="{body}"><include file="{_object_path(file)}"/></body>' for body, file in _OBJECT_FILES.items()]
    folder = assets / "sawyer_xyz"
    return f"""
    <mujoco model="multimodal_metaworld">
      <compiler meshdir="{folder}" texturedir="{folder}" angle="radian"/>
      {"".join(includes)}
      <worldbody>
        <include file="{assets / "objects" / "assets" / "xyz_base.xml"}"/>
        {"".join(bodies)}
        <site name="goal" size="0.02"/>
      </worldbody>
      <actuator>
        <position ctrllimited="true" ctrlrange="-1 1" joint="r_close" kp="400" user="1"/>
        <position ctrllimited="true" ctrlrange="-1 1" joint="l_close" kp="400" user="1"/>
      </actuator>
      <equality><weld body1="mocap" body2="hand" solref="0.02 1"/></equality>
    </mujoco>"""


def _coarsened(path: Path, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """
    A mesh with the vertices of each cell of a grid merged into their mean.

    :param path: binary STL file
    :param cell: edge of a cell in the file's units
    :return: (V, 3) vertices and (F, 3) vertex indices of the faces that keep three corners
    """
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.fromfile(path, dtype=record, offset=84)["corners"].reshape(-1, 3)
    place = np.floor(corners / cell).astype(np.int64)
    place -= place.min(axis=0)
    key = np.ravel_multi_index(tuple(place.T), tuple(place.max(axis=0) + 1))
    _, cluster, size = np.unique(key, return_inverse=True, return_counts=True)
    vertices = np.stack([np.bincount(cluster, corners[:, axis]) / size for axis in range(3)], axis=1)
    faces = cluster.reshape(-1, 3)
    kept = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return vertices, faces[kept]


def _add_coarse_arm(spec: mujoco.MjSpec) -> None:
    """Most of a 64-pixel frame's cost is the arm's fine meshes: give each a coarse twin, and a group by which to choose."""
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    for geom in list(spec.geoms):
        mesh = meshes.get(geom.meshname)
        if mesh is None or "xyz_base" not in Path(mesh.file).parts:
            continue
        geom.group = FINE_ARM_GROUP
        vertices, faces = _coarsened(ENV_ASSET_DIR_V3 / "sawyer_xyz" / mesh.file, _COARSE_CELL)
        twin = spec.add_mesh(name=f"{mesh.name}_coarse", uservert=vertices.ravel(), userface=faces.ravel())
        geom.parent.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=twin.name,
            pos=geom.pos,
            quat=geom.quat,
            rgba=geom.rgba,
            group=COARSE_ARM_GROUP,
            contype=0,
            conaffinity=0,
            mass=0,
        )


def _make_success_visible(spec: mujoco.MjSpec) -> None:
    """At 64 pixels a dark dial's angle and a puck under its net are lost on a person: colours only, nothing moves."""
    for geom in spec.geoms:
        if geom.meshname == "dialhead":
            geom.material, geom.rgba = "", (0.95, 0.95, 0.9, 1.0)
        elif geom.meshname == "goal_net":
            geom.material, geom.rgba = "", (0.85, 0.85, 0.85, 0.12)
    for material in spec.materials:
        material.reflectance = 0.0  # each mirror draws the scene once more


@lru_cache(maxsize=1)
def _compiled() -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    """
    :return: the model, and the settled arm's positions and velocities; shared in this process, never to be changed
    """
    spec = mujoco.MjSpec.from_string(_scene_xml())
    # The lever and the puck use these names too, and the stock task classes look theirs up.
    for geom in spec.geoms:
        if geom.name == "objGeom" and geom.parent.name == "drawer_link":
            geom.name = "drawer_handle"
    for joint in spec.joints:
        if joint.name == "goal_slidey" and joint.parent.name == "drawer_link":
            joint.name = "drawer_slide"
    _make_success_visible(spec)
    _add_coarse_arm(spec)
    model = spec.compile()
    # Meta-World's own weld between mocap and hand: relative pose (0, -1 0 0 0), torque scale 5.
    model.eq_data[model.eq_type == mujoco.mjtEq.mjEQ_WELD] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]

    data = mujoco.MjData(model)
    data.mocap_pos[:] = INITIAL_HAND_POSITION
    data.mocap_quat[:] = MOCAP_QUAT
    data.ctrl[:] = (-1.0, 1.0)
    mujoco.mj_step(model, data, nstep=_SETTLE_STEPS)
    return model, data.qpos[:N_ARM_JOINTS].copy(), data.qvel[:N_ARM_JOINTS].copy()


class TableScene:
    """
    One simulation of the shared table. Knows bodies and motion, not tasks.

    The model is compiled, and the arm settled, once in a process; an instance has its own copy.
    """

    def __init__(self) -> None:
        model, self._arm_qpos, self._arm_qvel = _compiled()
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self._body_ids = np.array([self.model.body(name).id for name in BODY_POSITIONS])
        self._nominal = np.array(list(BODY_POSITIONS.values()))

    def reset(self, offsets: np.ndarray) -> None:
        """
        Put everything back to the start of an episode.

        :param offsets: (6, 2) float, metres in x and y added to `BODY_POSITIONS`, in that order
        """
        mujoco.mj_resetData(self.model, self.data)
        self.model.body_pos[self._body_ids] = self._nominal
        self.model.body_pos[self._body_ids, :2] += offsets
        self.data.qpos[:N_ARM_JOINTS] = self._arm_qpos
        self.data.qvel[:N_ARM_JOINTS] = self._arm_qvel
        self.data.mocap_pos[:] = INITIAL_HAND_POSITION
        self.data.mocap_quat[:] = MOCAP_QUAT
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: np.ndarray, repeat: int) -> None:
        """
        Apply one action for `repeat` of Meta-World's control steps.

        :param action: (4,) float in [-1, 1]: hand displacement (1 is 1 cm a control step), gripper effort
        :param repeat: number of control steps, of 5 physics steps (12.5 ms) each
        """
        displacement = np.asarray(action[:3], dtype=np.float64) / 100.0
        self.data.ctrl[:] = (action[3], -action[3])
        for _ in range(repeat):
            self.data.mocap_pos[0] = np.clip(self.data.mocap_pos[0] + displacement, MOCAP_LOW, MOCAP_HIGH)
            mujoco.mj_step(self.model, self.data, nstep=5)
        # A step leaves positions of bodies and sites one physics step behind qpos.
        mujoco.mj_forward(self.model, self.data)

    def get_state(self) -> np.ndarray:
        """
        :return: (30,) float64: joint positions (15), mocap position (3), x and y of the six bodies (12).
            Enough to draw the scene again, not to continue the very same motion (no velocities).
        """
        return np.concatenate((self.data.qpos, self.data.mocap_pos[0], self.model.body_pos[self._body_ids, :2].ravel()))

    def initial_state(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: (30,) float, of any moment of an episode
        :return: (30,) float64, of that episode's start: the arm and every joint as after `reset`, the bodies where they are
        """
        joints = np.zeros(self.model.nq)
        joints[:N_ARM_JOINTS] = self._arm_qpos
        return np.concatenate((joints, INITIAL_HAND_POSITION, state[self.model.nq + 3 :]))

    def set_state(self, state: np.ndarray) -> None:
        """
        :param state: (30,) float, what `get_state` returned; velocities become 0
        """
        nq = self.model.nq
        if np.shape(state) != (nq + 15,):
            raise ValueError(f"A scene state has shape ({nq + 15},), got {np.shape(state)}.")
        self.reset(np.zeros((len(self._body_ids), 2)))
        self.model.body_pos[self._body_ids, :2] = np.reshape(state[nq + 3 :], (-1, 2))
        self.data.qpos[:] = state[:nq]
        self.data.qvel[:] = 0.0
        self.data.mocap_pos[0] = state[nq : nq + 3]
        mujoco.mj_forward(self.model, self.data)
