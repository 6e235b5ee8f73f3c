"""The structure of the package: imports form no circle and point from higher rooms to lower ones, wherever they stand."""

import ast
from pathlib import Path

from sb3_offline import ALGOS

ROOT = Path(__file__).parent.parent

#: Rooms from the ground up. A room may import itself and any room below it. Algorithms share one floor.
FLOORS = [
    ["data", "envs", "parallel"],
    ["common"],
    ["labelling"],
    ["ALGORITHMS"],
    ["evaluation"],
    ["data_tools", "experiment"],
    ["benchmark"],
    ["report"],
    ["demo", "zoo"],
    ["commands"],
    ["cli"],
]
#: Algorithms that build on another one
BUILT_ON = {"rce": {"ceborl"}, "dcql": {"cql"}, "oril": {"cql"}, "rebrac": {"td3_bc"}}


def modules() -> dict[str, Path]:
    """All modules by name, as they are when installed."""
    found = {}
    for folder, package in ((ROOT / "sb3_offline", "sb3_offline"), (ROOT / "data_tools", "sb3_offline.data_tools")):
        for path in folder.rglob("*.py"):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            if path.is_relative_to(folder / "data_tools") or path.is_relative_to(folder / "zoo_configs"):
                continue  # links in a work tree
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that a file imports: at its top, in functions, and for types alone."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in known else str(node.module)
                for alias in node.names
            }
    return {name for name in found if name in known}


def room_of(module: str) -> str:
    parts = module.split(".")
    if len(parts) == 1:
        return "sb3_offline"
    return "ALGORITHMS" if parts[1] in algorithms() else parts[1]


def algorithms() -> set[str]:
    return {cls.__module__.split(".")[1] for cls in ALGOS.values()}


def test_imports_form_no_circle():
    known = modules()
    graph = {name: imports_of(path, known) - {name} for name, path in known.items()}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, "a circle: " + " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for other in sorted(graph[name]):
                visit(other, (*path, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_imports_point_to_lower_rooms():
    known = modules()
    floors = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
    assert {room_of(name) for name in known} - {"sb3_offline"} == floors.keys()
    for name, path in known.items():
        own, room = room_of(name), name.split(".")[1] if "." in name else ""
        for other in imports_of(path, known):
            if "sb3_offline" in (own, room_of(other)):
                continue  # the package's face: the registry, and those above the algorithms who ask it
            upwards = floors[room_of(other)] > floors[own]
            sideways = floors[room_of(other)] == floors[own] and other.split(".")[1] != room
            allowed = own == "ALGORITHMS" and other.split(".")[1] in BUILT_ON.get(room, set())
            assert not upwards and (not sideways or allowed), f"{path.relative_to(ROOT)} imports {other}"


def test_below_the_registry_nobody_asks_it():
    known = modules()
    for name, path in known.items():
        if room_of(name) in ("data", "envs", "common", "labelling", "ALGORITHMS", "evaluation", "data_tools"):
            assert "sb3_offline" not in imports_of(path, known), f"{path.relative_to(ROOT)} imports the package's face"
