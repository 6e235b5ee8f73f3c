"""The simulation of a table: one arm and the objects of all tasks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import lru_cache

import mujoco
import numpy as np

from sb3_offline.envs.multimodal_metaworld.composition import compose
from sb3_offline.envs.multimodal_metaworld.tables import Table

INITIAL_HAND_POSITION = np.array([0.0, 0.6, 0.2])
"""Where the hand starts (m). The same for every task: a start of its own would give the task away."""

MOCAP_LOW = np.array([-0.6, 0.40, 0.05])
MOCAP_HIGH = np.array([0.65, 1.0, 0.5])
MOCAP_QUAT = np.array([1.0, 0.0, 1.0, 0.0])

JITTER = 0.015
"""Half-width (m) of the uniform x and y noise that a reset adds to each body position."""

N_ARM_JOINTS = 9
"""Seven arm joints and two fingers come first in qpos and qvel."""

_SETTLE_STEPS = 500


@lru_cache(maxsize=8)
def _settled(table: Table) -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    """
    :return: the model, and the settled arm's positions and velocities; shared in this process, never to be changed
    """
    model = compose(table.objects)
    data = mujoco.MjData(model)
    data.mocap_pos[:] = INITIAL_HAND_POSITION
    data.mocap_quat[:] = MOCAP_QUAT
    data.ctrl[:] = (-1.0, 1.0)
    mujoco.mj_step(model, data, nstep=_SETTLE_STEPS)
    return model, data.qpos[:N_ARM_JOINTS].copy(), data.qvel[:N_ARM_JOINTS].copy()


class TableScene:
    """
    One simulation of a table. Knows bodies and motion, not tasks.

    The model is compiled, and the arm settled, once in a process for each table; an instance has its own copy.

    :param table: what stands where
    """

    def __init__(self, table: Table) -> None:
        self.table = table
        model, self._arm_qpos, self._arm_qvel = _settled(table)
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self._body_ids = np.array([self.model.body(name).id for name in table.positions])
        self._nominal = np.array(list(table.positions.values()))
        self._start_qpos = np.zeros(self.model.nq)
        self._start_qpos[:N_ARM_JOINTS] = self._arm_qpos
        for thing in table.objects.values():
            for joint, position in thing.start.items():
                self._start_qpos[self.model.joint(joint).qposadr[0]] = position

    def draw_offsets(self, rng: np.random.Generator) -> np.ndarray:
        """
        :param rng: the source of randomness
        :return: (n_bodies, 2) float64, for `reset`
        """
        return rng.uniform(-JITTER, JITTER, self._nominal[:, :2].shape)

    def reset(self, offsets: np.ndarray | None = None) -> None:
        """
        Put everything back to the start of an episode.

        :param offsets: (n_bodies, 2) float, metres in x and y added to the table's nominal positions, in their order
            (default: none)
        """
        mujoco.mj_resetData(self.model, self.data)
        self.model.body_pos[self._body_ids] = self._nominal
        if offsets is not None:
            self.model.body_pos[self._body_ids, :2] += offsets
        self.data.qpos[:] = self._start_qpos
        self.data.qvel[:N_ARM_JOINTS] = self._arm_qvel
        self.data.mocap_pos[:] = INITIAL_HAND_POSITION
        self.data.mocap_quat[:] = MOCAP_QUAT
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: np.ndarray, repeat: int, between: Callable[[], None] | None = None) -> None:
        """
        Apply one action for `repeat` of Meta-World's control steps.

        :param action: (4,) float in [-1, 1]: hand displacement (1 is 1 cm a control step), gripper effort
        :param repeat: number of control steps, of 5 physics steps (12.5 ms) each
        :param between: called after each control step but the last, with the positions of bodies, geoms and sites up to date;
            the motion is the same, to the bit, with and without it
        """
        displacement = np.asarray(action[:3], dtype=np.float64) / 100.0
        self.data.ctrl[:] = (action[3], -action[3])
        for i in range(repeat):
            self.data.mocap_pos[0] = np.clip(self.data.mocap_pos[0] + displacement, MOCAP_LOW, MOCAP_HIGH)
            mujoco.mj_step(self.model, self.data, nstep=5)
            if between is not None and i < repeat - 1:
                # Positions only: mj_forward would leave the solver another starting point for the next step.
                mujoco.mj_kinematics(self.model, self.data)
                between()
        # A step leaves positions of bodies and sites one physics step behind qpos.
        mujoco.mj_forward(self.model, self.data)

    def body_position(self, name: str) -> np.ndarray:
        """
        :param name: of an object
        :return: (3,) float64, where it stands in this episode (m)
        """
        return self.model.body(name).pos.copy()

    def get_state(self) -> np.ndarray:
        """
        :return: (n,) float64: joint positions, mocap position (3), x and y of each object, as `Table.scene_state` lists them.
            Enough to draw the scene again, but not to continue the very same motion, for it holds no velocities.
        """
        return np.concatenate((self.data.qpos, self.data.mocap_pos[0], self.model.body_pos[self._body_ids, :2].ravel()))

    def initial_state(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: (n,) float, of any moment of an episode
        :return: (n,) float64, of that episode's start: the arm and every joint as after `reset`, the objects where they are
        """
        return np.concatenate((self._start_qpos, INITIAL_HAND_POSITION, state[self.model.nq + 3 :]))

    def set_state(self, state: np.ndarray) -> None:
        """
        :param state: (n,) float, what `get_state` returned; velocities become 0
        """
        nq = self.model.nq
        shape = (nq + 3 + 2 * len(self._body_ids),)
        if np.shape(state) != shape:
            raise ValueError(f"A scene state of table {self.table.name!r} has shape {shape}, got {np.shape(state)}.")
        self.reset()
        self.model.body_pos[self._body_ids, :2] = np.reshape(state[nq + 3 :], (-1, 2))
        self.data.qpos[:] = state[:nq]
        self.data.qvel[:] = 0.0
        self.data.mocap_pos[0] = state[nq : nq + 3]
        mujoco.mj_forward(self.model, self.data)
