"""The stock Meta-World task classes, unmodified, judging one shared scene: their rewards and their success."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from sb3_offline.envs.multimodal_metaworld.scene import TableScene
from sb3_offline.envs.multimodal_metaworld.tasks import STOCK_TASKS, StockTask


class _Renamed:
    """
    A MuJoCo model or data object whose elements answer to the names that a stock class knows.

    :param target: model or data
    :param aliases: names that are looked up to the names that `target` has
    """

    def __init__(self, target: Any, aliases: Mapping[str, str]) -> None:
        self._target, self._aliases = target, aliases

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._target, name)
        if name not in ("body", "geom", "joint", "site"):
            return attribute
        return lambda element: attribute(self._aliases.get(element, element))


class _OnSharedTable(SawyerXYZEnv):
    """
    Base class that goes before a stock class. It takes the simulation from a scene, leaves the arm where it is and the objects
    where the scene has put them. `step` and `reset` of the stock class are never called.
    """

    _task: StockTask

    def __init__(self, scene: TableScene) -> None:
        self._scene = scene
        super().__init__()
        self._set_task_called = True
        hand, claws = self.model.body("hand").id, [self.model.body(name).id for name in ("rightclaw", "leftclaw")]
        self._hand_id, self._claw_ids = hand, claws
        if self._task.aliases:
            # Only now: MuJoCo's own functions, which the stock constructors call, take nothing but the original objects.
            self.model, self.data = _Renamed(self.model, self._task.aliases), _Renamed(self.data, self._task.aliases)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self._scene.model, self._scene.data

    def _reset_hand(self, steps: int = 50) -> None:
        self.init_tcp = self.tcp_center

    def _set_obj_xyz(self, pos: np.ndarray) -> None:
        if self._task.sets_joints:
            super()._set_obj_xyz(pos)

    def _get_curr_obs_combined_no_goal(self) -> np.ndarray:
        return np.zeros(18)  # a part of the stock observations, which nobody reads here

    def _get_state_rand_vec(self) -> np.ndarray:
        return self._task.placement(*(self._scene.body_position(name) for name in self._task.objects))

    def stock_observation(self) -> np.ndarray:
        """
        :return: (39,) float64, the part of the stock observation that rewards and scripted policies read: hand, gripper
            opening, object position, and the goal at the end; zeros elsewhere. It holds the goal, so learners must not see it.
        """
        right, left = self.data.xpos[self._claw_ids]
        observation = np.zeros(39)
        observation[:3] = self.data.xpos[self._hand_id]
        observation[3] = min(np.linalg.norm(right - left) / 0.1, 1.0)
        observation[4:7] = self._get_pos_objects()
        observation[-3:] = self._target_pos
        return observation

    def judge(self, action: np.ndarray) -> tuple[float, bool]:
        """
        :param action: (4,) float in [-1, 1], the action that led here
        :return: stock reward and success in the present state
        """
        reward, info = self.evaluate_state(self.stock_observation(), action)
        return float(reward), bool(info["success"])


def make_judges(scene: TableScene) -> list[Any]:
    """
    :param scene: the simulation that they share
    :return: one judge for each task of the scene's table, in its order
    """
    judges = []
    for name in scene.table.tasks:
        task = STOCK_TASKS[name]
        judges.append(type(task.env_class.__name__, (_OnSharedTable, task.env_class), {"_task": task})(scene))
    return judges
