"""Multimodal Meta-World: five manipulation tasks on one table, none of them named in the observation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_offline.envs.multimodal_metaworld.rendering import CAMERA, FRAME_SIZE, SceneRenderer
from sb3_offline.envs.multimodal_metaworld.scene import BODY_POSITIONS, JITTER, TableScene
from sb3_offline.envs.multimodal_metaworld.tasks import TASKS, make_tasks

STATE_NAMES = (
    *("hand_x", "hand_y", "hand_z", "gripper_opening"),
    *("dial_x", "dial_y", "dial_angle"),
    *("door_handle_x", "door_handle_y", "door_angle"),
    *("drawer_x", "drawer_y", "drawer_slide"),
    *("lever_tip_x", "lever_tip_y", "lever_tip_z", "lever_angle"),
    *("puck_x", "puck_y", "puck_goal_x", "puck_goal_y"),
)
"""What the entries of a state observation are: metres and radians, the gripper's opening in [0, 1]."""
EPISODE_LENGTH = 50
"""Decisions in an episode, unless told otherwise."""
# Wide enough for every reachable value, joint limits being soft.
_STATE_BOUND = np.array([4.0 if name.endswith("angle") else 2.0 for name in STATE_NAMES], dtype=np.float32)


class MultimodalMetaworldEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    Five Meta-World tasks around one arm, as in the CEBORL paper. Every task begins alike, and neither frames nor states tell
    which one is meant; `task` only chooses the reward and `info["success"]`.

    An action (hand displacement in x, y, z and gripper effort) is repeated `action_repeat` times; reward and success are those
    of the state at the end. An episode never terminates and is truncated after `episode_length` decisions.

    :param task: one of `TASKS`
    :param obs_type: "pixels" for (frame_size, frame_size, 3) uint8 frames, "state" for the vector `STATE_NAMES` (float32)
    :param render_mode: "rgb_array" or None
    :param episode_length: decisions in an episode
    :param action_repeat: control steps of 12.5 ms in a decision
    :param width: of the pictures of `render()`, whatever the `frame_size`
    :param height: of the pictures of `render()`
    :param frame_size: width and height of the observed frames in pixels
    :param camera: in place of entries of `CAMERA`: `lookat` (x, y, z) and `distance` in metres, `azimuth` and `elevation` in
        degrees
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "door-open",
        obs_type: str = "pixels",
        render_mode: str | None = None,
        episode_length: int = EPISODE_LENGTH,
        action_repeat: int = 4,
        width: int = 480,
        height: int = 480,
        frame_size: int = FRAME_SIZE,
        camera: Mapping[str, Any] | None = None,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"Unknown task {task!r}; choose one of {', '.join(TASKS)}.")
        if obs_type not in ("pixels", "state"):
            raise ValueError(f'Unknown obs_type {obs_type!r}; choose "pixels" or "state".')
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'Unknown render_mode {render_mode!r}; choose "rgb_array" or None.')
        if frame_size < 1:
            raise ValueError(f"frame_size is {frame_size}; give the width of a frame in pixels.")
        if unknown := set(camera or {}) - set(CAMERA):
            raise ValueError(f"Unknown entries {sorted(unknown)} of camera; choose from {', '.join(CAMERA)}.")
        self.task = task
        self.obs_type = obs_type
        self.render_mode = render_mode
        self.episode_length = episode_length
        self.action_repeat = action_repeat
        self.width, self.height = width, height
        self.frame_size = frame_size
        self.camera = {**CAMERA, **(camera or {})}
        self.scene = TableScene()
        self._tasks = make_tasks(self.scene)
        self._task_index = TASKS.index(task)
        self._n_decisions = 0
        self._solved = False
        self._renderer: SceneRenderer | None = None

        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space: spaces.Box
        if obs_type == "pixels":
            self.observation_space = spaces.Box(0, 255, (frame_size, frame_size, 3), np.uint8)
        else:
            self.observation_space = spaces.Box(-_STATE_BOUND, _STATE_BOUND, dtype=np.float32)

        model = self.scene.model
        self._joints = [model.joint(name).qposadr[0] for name in ("knob_Joint_1", "doorjoint", "drawer_slide", "LeverAxis")]
        self._hand = model.body("hand").id
        self._claws = [model.body(name).id for name in ("rightclaw", "leftclaw")]
        self._dial = model.body("dial").id
        self._drawer = model.body("drawer_link").id
        self._puck_goal = model.body("puck_goal").id
        self._door_handle = model.geom("handle").id
        self._puck = model.geom("puck").id
        self._lever_tip = model.site("leverStart").id

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param seed: of the objects' places; the same seed gives the same start for every task
        :param options: not used
        :return: observation and info, which holds the same success entries as `step`'s
        """
        super().reset(seed=seed)
        self.scene.reset(self.np_random.uniform(-JITTER, JITTER, (len(BODY_POSITIONS), 2)))
        for task in self._tasks:
            task.reset_model()
        self._n_decisions = 0
        self._solved = False
        return self._observation(), self._judge(np.zeros(4))[1]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: (4,) float, clipped to [-1, 1]
        :return: observation, stock reward of the chosen task, False, truncated, and info:
            `success` (bool), the chosen task's, now;
            `is_success` (bool), the same at any decision of this episode so far: SB3 reads it at the end, a lever falls back;
            `task_success` ((5,) bool) and `task_reward` ((5,) float32), of all tasks, now, in the order of `TASKS`
        """
        action = np.clip(np.asarray(action, dtype=np.float32), -1.0, 1.0)
        self.scene.advance(action, self.action_repeat)
        self._n_decisions += 1
        reward, info = self._judge(action)
        return self._observation(), reward, False, self._n_decisions >= self.episode_length, info

    def stock_observation(self, task: str) -> np.ndarray:
        """
        :param task: one of `TASKS`, not necessarily the chosen one
        :return: (39,) float64, what that task's scripted policy of Meta-World reads; it holds the goal
        """
        return self._tasks[TASKS.index(task)].stock_observation()

    def _judge(self, action: np.ndarray) -> tuple[float, dict[str, Any]]:
        verdicts = [task.judge(action) for task in self._tasks]
        reward, success = verdicts[self._task_index]
        self._solved = self._solved or success
        info = {
            "success": success,
            "is_success": self._solved,
            "task_success": np.array([verdict[1] for verdict in verdicts]),
            "task_reward": np.array([verdict[0] for verdict in verdicts], dtype=np.float32),
        }
        return reward, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """
        :return: (height, width, 3) uint8, or None without a render_mode
        """
        return None if self.render_mode is None else self.get_picture(self.width, self.height)

    def get_picture(self, width: int, height: int) -> np.ndarray:
        """
        :param width: in pixels
        :param height: in pixels
        :return: (height, width, 3) uint8 of the scene as it is, for people: finer than the observation
        """
        return self._get_renderer().picture(width, height)

    def get_frame(self) -> np.ndarray:
        """
        :return: (frame_size, frame_size, 3) uint8 of the scene as it is: the observation of obs_type "pixels", also where this
            environment observes states
        """
        return self._get_renderer().frame()

    def get_render_device(self) -> str:
        """
        :return: what draws here, as OpenGL names it: frames are the same to the byte on the same device only
        """
        return self._get_renderer().device()

    def close(self) -> None:
        """Free the OpenGL context, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _get_renderer(self) -> SceneRenderer:
        # Made late: neither state observations nor the import of this module may need OpenGL.
        if self._renderer is None:
            self._renderer = SceneRenderer(self.scene, self.frame_size, self.camera)
        return self._renderer

    def _observation(self) -> np.ndarray:
        return self.get_frame() if self.obs_type == "pixels" else self.get_state()

    def get_state(self) -> np.ndarray:
        """
        :return: (21,) float32 of the scene as it is: the observation of obs_type "state", whatever this one's is
        """
        data = self.scene.data
        xpos, geoms = data.xpos, data.geom_xpos
        dial, door, drawer, lever = data.qpos[self._joints]
        right, left = xpos[self._claws]
        state = np.array(
            [
                *xpos[self._hand],
                min(np.linalg.norm(right - left) / 0.1, 1.0),
                *xpos[self._dial, :2],
                dial,
                *geoms[self._door_handle, :2],
                door,
                xpos[self._drawer, 0],
                xpos[self._drawer, 1],
                drawer,
                *data.site_xpos[self._lever_tip],
                lever,
                *geoms[self._puck, :2],
                *xpos[self._puck_goal, :2],
            ],
            dtype=np.float32,
        )
        return np.clip(state, -_STATE_BOUND, _STATE_BOUND)
