"""The state observation: the arm and every object of a table in one vector."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from sb3_offline.envs.multimodal_metaworld.tasks import Quantity

HAND_NAMES = ("hand_x", "hand_y", "hand_z", "gripper_opening")
"""The first entries of every state: metres, and the opening in [0, 1]."""

_WIDEST_OPENING = 0.1  # metres between the claws


class StateReader:
    """
    Reads the state of a simulation.

    :param model: of the scene
    :param data: of the scene; read at every call
    :param quantities: name of each entry after `HAND_NAMES` to what it is
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, quantities: Mapping[str, Quantity]) -> None:
        # Wide enough for every reachable value: joint limits are soft.
        bounds = [4.0 if name.endswith("angle") else 2.0 for name in (*HAND_NAMES, *quantities)]
        self.bound = np.array(bounds, dtype=np.float32)
        """(n,) float32, the largest absolute value of each entry"""
        # Views of the simulation's memory, which stays where it is.
        self._hand = data.xpos[model.body("hand").id]
        self._claws = [data.xpos[model.body(name).id] for name in ("rightclaw", "leftclaw")]
        places = {"body": data.xpos, "geom": data.geom_xpos, "site": data.site_xpos}
        self._sources: list[tuple[np.ndarray, int]] = []
        for kind, name, axis in quantities.values():
            if kind == "joint":
                self._sources.append((data.qpos, int(model.joint(name).qposadr[0])))
            else:
                self._sources.append((places[kind][getattr(model, kind)(name).id], axis))

    def read(self) -> np.ndarray:
        """
        :return: (n,) float32
        """
        right, left = self._claws
        opening = min(np.linalg.norm(right - left) / _WIDEST_OPENING, 1.0)
        values = [array[index] for array, index in self._sources]
        return np.clip(np.array([*self._hand, opening, *values], dtype=np.float32), -self.bound, self.bound)
