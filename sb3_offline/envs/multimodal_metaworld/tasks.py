"""The stock Meta-World task classes, unmodified, judging one shared scene: their rewards and their success."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from metaworld.envs.sawyer_dial_turn_v3 import SawyerDialTurnEnvV3
from metaworld.envs.sawyer_door_v3 import SawyerDoorEnvV3
from metaworld.envs.sawyer_drawer_open_v3 import SawyerDrawerOpenEnvV3
from metaworld.envs.sawyer_lever_pull_v3 import SawyerLeverPullEnvV3
from metaworld.envs.sawyer_plate_slide_v3 import SawyerPlateSlideEnvV3
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from sb3_offline.envs.multimodal_metaworld.scene import TableScene


class _OnSharedTable(SawyerXYZEnv):
    """
    Comes before a stock class: it takes the simulation from a scene, leaves the arm where it is and the objects where the
    scene has put them. `step` and `reset` of the stock class are never called.
    """

    _placement: Callable[[TableScene], np.ndarray]

    def __init__(self, scene: TableScene) -> None:
        self._scene = scene
        super().__init__()
        self._set_task_called = True
        hand, claws = self.model.body("hand").id, [self.model.body(name).id for name in ("rightclaw", "leftclaw")]
        self._hand_id, self._claw_ids = hand, claws

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self._scene.model, self._scene.data

    def _reset_hand(self, steps: int = 50) -> None:
        self.init_tcp = self.tcp_center

    def _get_state_rand_vec(self) -> np.ndarray:
        return self._placement(self._scene)

    def stock_observation(self) -> np.ndarray:
        """
        :return: (39,) float64, the part of the stock observation that rewards and scripted policies read: hand, gripper
            opening, object position, and the goal at the end; zeros elsewhere. The goal never leaves the room.
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


def _body_position(scene: TableScene, name: str) -> np.ndarray:
    return scene.model.body(name).pos.copy()


def _at(body: str) -> Callable[[TableScene], np.ndarray]:
    return lambda scene: _body_position(scene, body)


def _puck_and_goal(scene: TableScene) -> np.ndarray:
    # Stock plate-slide has its puck's start at z = 0, though its body stands 15 mm higher.
    return np.concatenate((_body_position(scene, "puck_channel") * (1.0, 1.0, 0.0), _body_position(scene, "puck_goal")))


_STOCK: dict[str, tuple[type[SawyerXYZEnv], Callable[[TableScene], np.ndarray]]] = {
    "dial-turn": (SawyerDialTurnEnvV3, _at("dial")),
    "door-open": (SawyerDoorEnvV3, _at("door")),
    "drawer-open": (SawyerDrawerOpenEnvV3, _at("drawer")),
    "lever-pull": (SawyerLeverPullEnvV3, _at("lever")),
    "plate-slide": (SawyerPlateSlideEnvV3, _puck_and_goal),
}


TASKS = tuple(_STOCK)
"""Names of the tasks, in the order of every per-task array."""


def make_tasks(scene: TableScene) -> list[Any]:
    """
    :param scene: the simulation that they share
    :return: one judge for each task, in the order of `TASKS`
    """
    return [
        type(stock.__name__, (_OnSharedTable, stock), {"_placement": staticmethod(at)})(scene) for stock, at in _STOCK.values()
    ]
