"""The tasks that a table can hold: stock Meta-World classes, the objects that they need, and entries of the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from metaworld.envs.sawyer_button_press_v3 import SawyerButtonPressEnvV3
from metaworld.envs.sawyer_dial_turn_v3 import SawyerDialTurnEnvV3
from metaworld.envs.sawyer_door_v3 import SawyerDoorEnvV3
from metaworld.envs.sawyer_drawer_open_v3 import SawyerDrawerOpenEnvV3
from metaworld.envs.sawyer_faucet_close_v3 import SawyerFaucetCloseEnvV3
from metaworld.envs.sawyer_faucet_open_v3 import SawyerFaucetOpenEnvV3
from metaworld.envs.sawyer_handle_press_v3 import SawyerHandlePressEnvV3
from metaworld.envs.sawyer_lever_pull_v3 import SawyerLeverPullEnvV3
from metaworld.envs.sawyer_plate_slide_v3 import SawyerPlateSlideEnvV3
from metaworld.envs.sawyer_window_open_v3 import SawyerWindowOpenEnvV3
from metaworld.sawyer_xyz_env import SawyerXYZEnv

Colour = tuple[float, float, float, float]


class Element(NamedTuple):
    """A named element of an object's file, which would otherwise share its name with an element of another object."""

    kind: str
    """One of "geom", "joint" and "site"."""
    parent: str
    """Name of the body that holds it."""
    name: str
    """Its name in the file, which may be empty."""


class Quantity(NamedTuple):
    """One entry of a state: a coordinate of a body, geom or site (m), or a joint's position (m or rad)."""

    kind: Literal["body", "geom", "site", "joint"]
    name: str
    axis: int = 0


@dataclass(frozen=True)
class TableObject:
    """
    An object of Meta-World's assets.

    :param file: its MJCF file
    :param dependencies: name of the file with its meshes and materials, without ``_dependencies.xml``
    :param sites: name to position (m, relative to the object) of the sites that stock scenes add outside of the file
    :param renamed: elements that get another name; no two names may clash on a table
    :param start: joint to its position (m or rad) at the start of an episode, where that is not 0
    :param colours: mesh or material to its colour, where success cannot be seen at 64 pixels in the stock colour
    """

    file: str
    dependencies: str
    sites: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    renamed: Mapping[Element, str] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    colours: Mapping[str, Colour] = field(default_factory=dict)


@dataclass(frozen=True)
class StockTask:
    """
    A task as Meta-World defines it.

    :param env_class: stock class, whose reward and success condition are used unmodified
    :param objects: the objects it needs, by the names that `TABLES` gives positions for
    :param state: what a state observation tells of the objects, by the names of its entries; names that end in "angle" are
        angles in radians, all others lengths in metres
    :param placement: from the positions of `objects`, in their order, to what the stock class would draw at random at a reset
    :param aliases: names that the stock class looks up to the names that they have on the table
    :param sets_joints: whether the stock class sets its joints at a reset; it must not where it takes them for the first ones
        after the arm's, unless they are (`joints_first`). The scene sets all joints to their start in any case
    :param joints_first: whether the joints are the first ones after the arm's
    """

    env_class: type[SawyerXYZEnv]
    objects: Mapping[str, TableObject]
    state: Mapping[str, Quantity]
    placement: Callable[..., np.ndarray] = lambda *positions: np.concatenate(positions)
    aliases: Mapping[str, str] = field(default_factory=dict)
    sets_joints: bool = True
    joints_first: bool = False


def _coordinates(name: str, kind: Literal["body", "geom", "site"], element: str, axes: str = "xy") -> dict[str, Quantity]:
    return {f"{name}_{axis}": Quantity(kind, element, "xyz".index(axis)) for axis in axes}


def _puck_and_goal(channel: np.ndarray, goal: np.ndarray) -> np.ndarray:
    # Stock plate-slide has its puck's start at z = 0, though its body stands 15 mm higher.
    return np.concatenate((channel * (1.0, 1.0, 0.0), goal))


_PUCK_NET: Colour = (0.85, 0.85, 0.85, 0.12)
_OFF_WHITE: Colour = (0.95, 0.95, 0.9, 1.0)
_BLUE: Colour = (0.1, 0.3, 0.9, 1.0)
_GREEN: Colour = (0.1, 0.75, 0.2, 1.0)

_FAUCET = TableObject(
    "faucet.xml",
    "faucet",
    sites={"goal_open": (0.175, 0.0, 0.125), "goal_close": (-0.175, 0.0, 0.125)},
    renamed={Element("joint", "faucet_link2", "knob_Joint_1"): "faucet_joint"},
    colours={"faucet_red": _BLUE},
)
_FAUCET_STATE = {**_coordinates("faucet_tip", "site", "handleStartOpen"), "faucet_angle": Quantity("joint", "faucet_joint")}

STOCK_TASKS: dict[str, StockTask] = {
    "dial-turn": StockTask(
        SawyerDialTurnEnvV3,
        {"dial": TableObject("dial.xml", "dial", colours={"dialhead": _OFF_WHITE})},
        {**_coordinates("dial", "body", "dial"), "dial_angle": Quantity("joint", "knob_Joint_1")},
    ),
    "door-open": StockTask(
        SawyerDoorEnvV3,
        {"door": TableObject("doorlockB.xml", "doorlock")},
        {**_coordinates("door_handle", "geom", "handle"), "door_angle": Quantity("joint", "doorjoint")},
    ),
    "drawer-open": StockTask(
        SawyerDrawerOpenEnvV3,
        {
            "drawer": TableObject(
                "drawer.xml",
                "drawer",
                renamed={
                    Element("geom", "drawer_link", "objGeom"): "drawer_handle",
                    Element("joint", "drawer_link", "goal_slidey"): "drawer_slide",
                },
            )
        },
        {**_coordinates("drawer", "body", "drawer_link"), "drawer_slide": Quantity("joint", "drawer_slide")},
    ),
    "lever-pull": StockTask(
        SawyerLeverPullEnvV3,
        {"lever": TableObject("lever.xml", "lever")},
        {**_coordinates("lever_tip", "site", "leverStart", "xyz"), "lever_angle": Quantity("joint", "LeverAxis")},
    ),
    "plate-slide": StockTask(
        SawyerPlateSlideEnvV3,
        {
            "puck_channel": TableObject("puck.xml", "puck_goal"),
            "puck_goal": TableObject("puck_goal.xml", "puck_goal", colours={"goal_net": _PUCK_NET}),
        },
        {**_coordinates("puck", "geom", "puck"), **_coordinates("puck_goal", "body", "puck_goal")},
        placement=_puck_and_goal,
        joints_first=True,
    ),
    "button-press": StockTask(
        SawyerButtonPressEnvV3,
        {
            "button_box": TableObject(
                "buttonbox.xml",
                "buttonbox",
                sites={"buttonStart": (0.0, -0.1935, 0.0), "hole": (0.0, -0.1, 0.0)},
                colours={"btn_red": _OFF_WHITE},
            )
        },
        {**_coordinates("button", "geom", "btnGeom"), "button_slide": Quantity("joint", "btnbox_joint")},
        aliases={"box": "button_box"},
        sets_joints=False,
    ),
    "faucet-close": StockTask(SawyerFaucetCloseEnvV3, {"faucetBase": _FAUCET}, _FAUCET_STATE),
    "faucet-open": StockTask(SawyerFaucetOpenEnvV3, {"faucetBase": _FAUCET}, _FAUCET_STATE),
    "handle-press": StockTask(
        SawyerHandlePressEnvV3,
        {
            "handle_box": TableObject(
                "handle_press.xml",
                "handle_press",
                sites={"goalPress": (0.0, -0.216, 0.075)},
                renamed={Element("joint", "handle_link", ""): "handle_slide"},
                colours={"hdlprs_red": _GREEN},
            )
        },
        {**_coordinates("handle", "site", "handleStart"), "handle_slide": Quantity("joint", "handle_slide")},
        aliases={"box": "handle_box"},
        sets_joints=False,
    ),
    "window-open": StockTask(
        SawyerWindowOpenEnvV3,
        {"window": TableObject("window_horiz.xml", "window", colours={"window_white": _OFF_WHITE})},
        {**_coordinates("window_handle", "site", "handleOpenStart"), "window_slide": Quantity("joint", "window_slide")},
    ),
}
"""Every task that a table can hold, by Meta-World's name."""
