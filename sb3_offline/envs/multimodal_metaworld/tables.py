"""What stands where: each table is a dict of positions for the objects of its tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from sb3_offline.envs.multimodal_metaworld.state import HAND_NAMES
from sb3_offline.envs.multimodal_metaworld.tasks import STOCK_TASKS, Quantity, TableObject

Position = tuple[float, float, float]

TABLES: dict[str, dict[str, dict[str, Position]]] = {
    "paper": {
        "dial-turn": {"dial": (-0.06, 0.50, 0.0)},
        "door-open": {"door": (-0.365, 0.94, 0.15)},
        "drawer-open": {"drawer": (0.045, 0.88, 0.0)},
        "lever-pull": {"lever": (0.26, 0.75, 0.0)},
        "plate-slide": {"puck_channel": (0.555, 0.47, 0.015), "puck_goal": (0.555, 0.72, 0.0)},
    },
    "second": {
        "button-press": {"button_box": (-0.15, 0.85, 0.115)},
        "faucet-close": {"faucetBase": (0.38, 0.58, 0.0)},
        "faucet-open": {},
        "handle-press": {"handle_box": (-0.53, 0.85, 0.0)},
        "window-open": {"window": (0.29, 0.9, 0.16)},
    },
}
"""
Each table's tasks, in the order of every per-task array, and for each task the nominal positions (m) of its objects. An object
that two tasks share is placed once. Each episode moves every object by up to `JITTER`, so positions must leave room for that.
"""


@dataclass(frozen=True, eq=False)
class Table:
    """
    A table as the scene, the judges and the observations need it.

    :param name: key in `TABLES`
    :param tasks: names of its tasks, in the order of every per-task array
    :param positions: body name of each object to its nominal position (m), in the order of the tasks
    :param objects: the objects by the same names, in the order of their joints
    :param state: what a state observation tells of the objects: name of each entry to where it is read
    """

    name: str
    tasks: tuple[str, ...]
    positions: Mapping[str, Position]
    objects: Mapping[str, TableObject]
    state: Mapping[str, Quantity]

    @property
    def state_names(self) -> tuple[str, ...]:
        """:return: names of the entries of a state observation"""
        return (*HAND_NAMES, *self.state)

    @property
    def scene_state(self) -> dict[str, slice]:
        """:return: the parts of a scene state: the joints (qpos), the hand's target, x and y of each object in `positions`"""
        bodies = 2 * len(self.positions)
        return {"joints": slice(0, -bodies - 3), "hand_target": slice(-bodies - 3, -bodies), "bodies": slice(-bodies, None)}


@lru_cache
def find_table(name: str) -> Table:
    """
    :param name: key in `TABLES`
    :return: the table; raises ``ValueError`` where there is none of that name, or where it does not place the objects that its
        tasks need
    """
    if name not in TABLES:
        raise ValueError(f"Unknown table {name!r}; choose one of {', '.join(TABLES)}.")
    tasks = TABLES[name]
    compiled_order = sorted(tasks, key=lambda task: not STOCK_TASKS[task].joints_first)
    positions = {body: position for bodies in tasks.values() for body, position in bodies.items()}
    objects = {body: thing for task in compiled_order for body, thing in STOCK_TASKS[task].objects.items()}
    if positions.keys() != objects.keys():
        raise ValueError(f"Table {name!r} places {', '.join(positions)}, but its tasks need {', '.join(objects)}.")
    return Table(
        name,
        tasks=tuple(tasks),
        positions=positions,
        objects=objects,
        state={entry: quantity for task in tasks for entry, quantity in STOCK_TASKS[task].state.items()},
    )


TASKS = find_table("paper").tasks
"""Names of the tasks of the paper's table, in the order of every per-task array."""

STATE_NAMES = find_table("paper").state_names
"""
What the entries of the paper's table's state observation are: metres and radians, the gripper's opening in [0, 1]. Those of
another table are in `find_table(name).state_names`.
"""
