"""A table's MuJoCo model, composed from the installed Meta-World's own assets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from metaworld.asset_path_utils import ENV_ASSET_DIR_V3

from sb3_offline.envs.multimodal_metaworld.tasks import Element, TableObject

FINE_ARM_GROUP = 2
"""Geom group of the arm's own meshes: MuJoCo draws groups 0 to 2 unless told otherwise."""

COARSE_ARM_GROUP = 3
"""Geom group of the coarse copies of these meshes, for small images."""

_COARSE_CELL = 0.015  # metres; a pixel of a 64-pixel image covers about 25 mm


def compose(objects: Mapping[str, TableObject]) -> mujoco.MjModel:
    """
    :param objects: body name to object, in the order of their joints; positions are set at every reset
    :return: the compiled model of the arm and the objects, which all stand at the origin
    """
    spec = mujoco.MjSpec.from_string(_scene_xml(objects))
    _rename(spec, objects)
    _make_success_visible(spec, objects)
    _add_coarse_arm(spec)
    model = spec.compile()
    # Meta-World's own weld between mocap and hand: relative pose (0, -1 0 0 0), torque scale 5.
    model.eq_data[model.eq_type == mujoco.mjtEq.mjEQ_WELD] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]
    return model


def _object_path(name: str) -> str:
    folder = ENV_ASSET_DIR_V3 / "objects"
    inner = folder / "assets" / name
    return str(inner if inner.exists() else folder / name)


def _scene_xml(objects: Mapping[str, TableObject]) -> str:
    assets = ENV_ASSET_DIR_V3
    dependencies = dict.fromkeys([*(thing.dependencies for thing in objects.values()), "xyz_base"])
    includes = [f'<include file="{assets / "scene" / "basic_scene.xml"}"/>']
    includes += [f'<include file="{assets / "objects" / "assets" / f"{name}_dependencies.xml"}"/>' for name in dependencies]
    bodies = [
        f'<body name="{name}"><include file="{_object_path(thing.file)}"/>{_sites_xml(thing)}</body>'
        for name, thing in objects.items()
    ]
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


def _sites_xml(thing: TableObject) -> str:
    return "".join(f'<site name="{name}" pos="{x} {y} {z}"/>' for name, (x, y, z) in thing.sites.items())


def _coarsened(path: Path, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Coarsen a mesh: merge all vertices in a cell of a grid into their mean.

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
    """Give each of the arm's meshes a coarse copy in a group of its own: the fine ones take most of a small image's time."""
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


def _rename(spec: mujoco.MjSpec, objects: Mapping[str, TableObject]) -> None:
    names = {element: name for thing in objects.values() for element, name in thing.renamed.items()}
    for kind, elements in (("geom", spec.geoms), ("joint", spec.joints), ("site", spec.sites)):
        for element in elements:
            element.name = names.get(Element(kind, element.parent.name, element.name), element.name)


def _make_success_visible(spec: mujoco.MjSpec, objects: Mapping[str, TableObject]) -> None:
    """At 64 pixels a dark dial's angle, or a red handle beside the red arm, cannot be seen. Only colours change."""
    colours = {name: colour for thing in objects.values() for name, colour in thing.colours.items()}
    for geom in spec.geoms:
        if geom.meshname in colours:
            geom.material, geom.rgba = "", colours[geom.meshname]
    for material in spec.materials:
        if material.name in colours:
            material.rgba = colours[material.name]
        material.reflectance = 0.0  # a mirror draws the scene once more
