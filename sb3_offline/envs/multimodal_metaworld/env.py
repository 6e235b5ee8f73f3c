"""Multimodal Meta-World: several manipulation tasks on one table, none of them named in the observation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_offline.envs.multimodal_metaworld.judges import make_judges
from sb3_offline.envs.multimodal_metaworld.rendering import CAMERAS, FRAME_SIZE, SceneRenderer
from sb3_offline.envs.multimodal_metaworld.scene import TableScene
from sb3_offline.envs.multimodal_metaworld.state import HAND_NAMES, StateReader
from sb3_offline.envs.multimodal_metaworld.tables import find_table

EPISODE_LENGTH = 50
"""Decisions in an episode by default."""

OBS_TYPES = ("pixels", "state", "both")
"""What an environment may observe."""

DEFAULT_TASK = "door-open"
"""The default task of a table that has it. Another table's default task is its first."""


class MultimodalMetaworldEnv(gym.Env[Any, np.ndarray]):
    """
    Several Meta-World tasks around one arm, as in the CEBORL paper. Every task of a table begins alike, and neither images nor
    states tell which one is meant; `task` only chooses the reward and `info["success"]`.

    An action (hand displacement in x, y, z and gripper effort) is repeated `action_repeat` times; the reward is that of the
    state at the end. An episode never terminates and is truncated after `episode_length` decisions.

    :param task: one of the table's tasks (default: "door-open" where the table has it, else the first)
    :param obs_type: "pixels" for (frame_size, frame_size, 3) uint8 images, "state" for the float32 vector `state_names`,
        "both" for a dict of such an `image` and of the `hand`: the entries of the state that a robot knows of itself
    :param render_mode: "rgb_array" or None
    :param episode_length: decisions in an episode
    :param action_repeat: control steps of 12.5 ms in a decision
    :param width: width of the images of `render()` in pixels, whatever the `frame_size`
    :param height: height of the images of `render()` in pixels
    :param frame_size: width and height of the observed images in pixels
    :param camera: name of a camera in `CAMERAS`, or entries that replace those of the default one: `lookat` (x, y, z) and
        `distance` in metres, `azimuth` and `elevation` in degrees
    :param table: name of a table in `TABLES`
    :param success: "last" to judge the state at the end of a decision, "any" to count a decision as successful if the task was
        solved after any of its control steps, as the CEBORL paper does
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str | None = None,
        obs_type: str = "pixels",
        render_mode: str | None = None,
        episode_length: int = EPISODE_LENGTH,
        action_repeat: int = 4,
        width: int = 480,
        height: int = 480,
        frame_size: int = FRAME_SIZE,
        camera: str | Mapping[str, Any] | None = None,
        table: str = "paper",
        success: str = "last",
    ) -> None:
        self.table = find_table(table)
        self.tasks = self.table.tasks
        if task is None:
            task = DEFAULT_TASK if DEFAULT_TASK in self.tasks else self.tasks[0]
        if task not in self.tasks:
            raise ValueError(f"Table {table!r} has no task {task!r}; choose one of {', '.join(self.tasks)}.")
        if obs_type not in OBS_TYPES:
            raise ValueError(f"Unknown obs_type {obs_type!r}; choose one of {', '.join(OBS_TYPES)}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'Unknown render_mode {render_mode!r}; choose "rgb_array" or None.')
        if frame_size < 1:
            raise ValueError(f"frame_size is {frame_size}; give the width of an image in pixels.")
        if success not in ("last", "any"):
            raise ValueError(f'Unknown success {success!r}; choose "last" or "any".')
        self.task = task
        self.obs_type = obs_type
        self.render_mode = render_mode
        self.episode_length = episode_length
        self.action_repeat = action_repeat
        self.width, self.height = width, height
        self.frame_size = frame_size
        self.camera = _find_camera(camera)
        self.success = success
        self.scene = TableScene(self.table)
        self.state_names = self.table.state_names
        self._judges = make_judges(self.scene)
        self._task_index = self.tasks.index(task)
        self._n_decisions = 0
        self._solved = False
        self._renderer: SceneRenderer | None = None

        self._state = StateReader(self.scene.model, self.scene.data, self.table.state)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        image, hand_bound = spaces.Box(0, 255, (frame_size, frame_size, 3), np.uint8), self._state.bound[: len(HAND_NAMES)]
        self.observation_space: spaces.Box | spaces.Dict
        if obs_type == "pixels":
            self.observation_space = image
        elif obs_type == "state":
            self.observation_space = spaces.Box(-self._state.bound, self._state.bound, dtype=np.float32)
        else:
            self.observation_space = spaces.Dict(hand=spaces.Box(-hand_bound, hand_bound, dtype=np.float32), image=image)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the objects' places; the same seed gives the same start for every task
        :param options: not used
        :return: observation and info, with the same entries as `step`'s
        """
        super().reset(seed=seed)
        self.scene.reset(self.scene.draw_offsets(self.np_random))
        for judge in self._judges:
            judge.reset_model()
        self._n_decisions = 0
        self._solved = False
        return self.get_observation(), self._judge(np.zeros(4))[1]

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        :param action: (4,) float, clipped to [-1, 1]
        :return: observation, stock reward of the chosen task, False, truncated, and info:
            `success` (bool), whether this decision solved the chosen task, as the option `success` counts it;
            `is_success` (bool), whether any decision of this episode so far did: SB3 reads it at the end of an episode, when a
            lever may have fallen back;
            `task_success` ((n_tasks,) bool) and `task_reward` ((n_tasks,) float32), `success` and reward of every task, in the
            order of `tasks`
        """
        action = np.clip(np.asarray(action, dtype=np.float32), -1.0, 1.0)
        passed = np.zeros(len(self.tasks), dtype=bool)

        def look() -> None:
            passed[:] |= [judge.judge(action)[1] for judge in self._judges]

        self.scene.advance(action, self.action_repeat, look if self.success == "any" else None)
        self._n_decisions += 1
        reward, info = self._judge(action, passed)
        return self.get_observation(), reward, False, self._n_decisions >= self.episode_length, info

    def stock_observation(self, task: str) -> np.ndarray:
        """
        :param task: one of the table's tasks, not necessarily the chosen one
        :return: (39,) float64, what that task's scripted policy of Meta-World reads; it holds the goal
        """
        return self._judges[self.tasks.index(task)].stock_observation()

    def _judge(self, action: np.ndarray, passed: np.ndarray | bool = False) -> tuple[float, dict[str, Any]]:
        """
        :param action: (4,) float, the one that led here
        :param passed: (n_tasks,) bool, the tasks that were solved on the way
        :return: reward of the chosen task, and info
        """
        verdicts = [judge.judge(action) for judge in self._judges]
        task_success = np.array([success for _, success in verdicts]) | passed
        success = bool(task_success[self._task_index])
        self._solved = self._solved or success
        info = {
            "success": success,
            "is_success": self._solved,
            "task_success": task_success,
            "task_reward": np.array([reward for reward, _ in verdicts], dtype=np.float32),
        }
        return verdicts[self._task_index][0], info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: (height, width, 3) uint8, or None without a render_mode
        """
        return None if self.render_mode is None else self.get_image(self.width, self.height)

    def get_image(self, width: int, height: int) -> np.ndarray:
        """
        :param width: width in pixels
        :param height: height in pixels
        :return: (height, width, 3) uint8, an image of the scene as it is, for people: finer than the observation
        """
        return self._get_renderer().draw(width, height)

    def get_frame(self) -> np.ndarray:
        """
        :return: (frame_size, frame_size, 3) uint8, an image of the scene as it is: the observation of obs_type "pixels", also
            where this environment observes states
        """
        return self._get_renderer().frame()

    def get_render_device(self) -> str:
        """
        :return: OpenGL's name of what draws here; images are the same to the byte only where it is the same
        """
        return self._get_renderer().device()

    def close(self) -> None:
        """Free the OpenGL context, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _get_renderer(self) -> SceneRenderer:
        # Made late, because neither state observations nor the import of this module may need OpenGL.
        if self._renderer is None:
            self._renderer = SceneRenderer(self.scene, self.frame_size, self.camera)
        return self._renderer

    def get_observation(self) -> np.ndarray | dict[str, np.ndarray]:
        """
        :return: the observation of the scene as it is
        """
        if self.obs_type == "both":
            return {"hand": self.get_state()[: len(HAND_NAMES)], "image": self.get_frame()}
        return self.get_frame() if self.obs_type == "pixels" else self.get_state()

    def get_state(self) -> np.ndarray:
        """
        :return: (n,) float32 of the scene as it is, its entries named by `state_names`: the observation of obs_type "state",
            also where this environment observes images
        """
        return self._state.read()


def _find_camera(camera: str | Mapping[str, Any] | None) -> dict[str, Any]:
    if isinstance(camera, str):
        if camera not in CAMERAS:
            raise ValueError(f"Unknown camera {camera!r}; choose one of {', '.join(CAMERAS)}, or give its entries.")
        return dict(CAMERAS[camera])
    if unknown := set(camera or {}) - set(CAMERAS["default"]):
        raise ValueError(f"Unknown entries {sorted(unknown)} of camera; choose from {', '.join(CAMERAS['default'])}.")
    return {**CAMERAS["default"], **(camera or {})}
