"""Scenes in .glb and .gltf. trimesh writes those without attributes; a process of its own bounds what reading takes."""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import refuse_pointer
from geokit.errors import FileFormatError
from geokit.formats.attributes import gltf
from geokit.formats.attributes.columns import utf8
from geokit.formats.attributes.gltf import holds_texture, holds_type
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.formats.file_content.references import LONGEST, require_inside
from geokit.formats.scene_content.gltf import is_animated, opened
from geokit.formats.scene_content.gltf_accessors import Accessors
from geokit.formats.scene_content.gltf_shapes import local_pose

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["holds_texture", "holds_type", "read_mesh", "write_mesh"]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_OTHERS = {1: "lines", 0: "points"}
_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error)


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read each mesh at each of its places in the scene graph; nothing is merged.

    Skins and morph targets have the pose of the file's nodes and weights; animations are left out, with a note.
    Attributes are those of the file; materials have a name, a base color and its texture. Buffers and images in other
    files are read from the file's own folder and from ``folders``.
    """

    def get(key: str) -> bytes:
        # References are URIs, in which a space is %20; many programs write plain names.
        for name in dict.fromkeys([key, unquote(key)]):
            found = require_inside(key, path.parent / name, path, folders)
            if os.path.exists(found):
                refuse_pointer(found)
                return found.read_bytes()
        raise FileFormatError(f"{path}: refers to {key[:LONGEST]!r}, which is missing; get it too")

    materials: tuple[FileMaterial, ...] = ()
    try:
        tree, accessors = opened(path, get)
        placed = list(_placed(tree, accessors))
        try:
            materials, notes = gltf.materials_of(tree, accessors.view, get)
        except _DAMAGE:
            notes = ("its materials are left out: their entries in the header are damaged",)
    except _DAMAGE as error:
        raise FileFormatError(
            f"{path}: its meshes cannot be read ({type(error).__name__}: {str(error)[:200]}); the file is damaged or "
            "not what its name says"
        ) from None
    notes = tuple(note.replace(f"{path}: ", "") for note in notes)
    if is_animated(tree):
        notes += ("its animations are left out: it is read as it stands without them",)
    bodies = [body for body in placed if isinstance(body, Body) and len(body.counts)]
    others = [body for body in placed if isinstance(body, str)]
    if not bodies:
        what = f"only {' and '.join(sorted(set(others)))}" if others else "no geometry with faces"
        raise FileFormatError(f"{path}: holds {what}; a mesh needs faces, export the surface itself")
    for what in _OTHERS.values():
        if count := others.count(what):
            notes += (f"its {what} (of {count} {'primitive' if count == 1 else 'primitives'}) are left out",)
    if not materials:
        bodies = [body._replace(polygon_data={}) for body in bodies]
    # The specification fixes both.
    bodies[0] = bodies[0]._replace(materials=materials, notes=notes, meters_per_unit=1.0, up_axis="y")
    return bodies


def _placed(tree: dict[str, Any], accessors: Accessors) -> Iterator[Body | str]:
    """The primitives of each node of the scene, its last nodes first; of points and lines their name."""
    meshes = [
        [found for part in mesh["primitives"] if (found := _read(part, accessors)) is not None]
        for mesh in tree.get("meshes", ())
    ]
    nodes = tree.get("nodes", [])
    names = _names(nodes)
    roots = tree["scenes"][tree.get("scene", 0)].get("nodes", []) if "scenes" in tree else []
    top = set(roots)
    parents: dict[int, int | None] = {}
    waiting: list[tuple[int | None, int]] = [(None, root) for root in roots]
    done = set()
    while waiting:
        if (edge := waiting.pop()) in done:  # as in damaged files
            continue
        done.add(edge)
        above, number = edge
        parents[number] = None if number in top else above
        waiting += [(number, child) for child in accessors.entry("nodes", number).get("children", ())]
    local = {number: local_pose(nodes[number]) for number in parents}
    for number in parents:
        if "mesh" not in nodes[number]:
            continue
        accessors.entry("meshes", nodes[number]["mesh"])
        parts = meshes[nodes[number]["mesh"]]
        transform = _pose(local, parents, number) if parts else None
        for at, part in enumerate(parts):
            name = f"{names[number]}_{at}" if len(parts) > 1 else names[number]
            yield part if isinstance(part, str) else part._replace(name=name, transform=transform)


def _read(part: dict[str, Any], accessors: Accessors) -> Body | str | None:
    """A primitive in its own frame."""
    mode = part.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return _OTHERS.get(mode)
    attributes = {name: accessors.stored(index) for name, index in part["attributes"].items()}
    points = attributes.pop("POSITION").astype(np.float64)
    if points.shape[1] != 3:
        raise ValueError(f"positions of {points.shape[1]} numbers")
    if "indices" in part:
        corners = accessors.stored(part["indices"]).reshape(-1).astype(np.int64)
    else:
        corners = np.arange(len(points))
    if mode == _TRIANGLES:
        faces = corners.reshape(-1, 3)
    elif mode == _STRIP:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]
    else:
        faces = np.stack([np.broadcast_to(corners[:1], corners[2:].shape), corners[1:-1], corners[2:]], axis=1)
    material = {}
    if "material" in part:
        accessors.entry("materials", part["material"])
        material = {"material": np.full(len(faces), part["material"], np.int32)}
    data = gltf.attributes_of(attributes)
    return Body(points, np.full(len(faces), 3), faces.ravel(), vertex_data=data, polygon_data=material)


def _names(nodes: list[dict[str, Any]]) -> list[str]:
    """Names of nodes; those that are taken go on from the number at their end."""
    taken: dict[str, None] = {}
    last: dict[str, int] = {}
    for number, node in enumerate(nodes):
        given = node.get("name", str(number))
        if given is not None and not isinstance(given, str):
            raise TypeError(f"the name {given!r}")
        name = given or "geometry"
        if not given or name in taken:
            stem, count = name, last.get(name, 0)
            before, line, end = name.rpartition("_")
            if not count and line and end.isdecimal():
                stem, count = before, int(end)
            last[name] = next(at for at in itertools.count(count + 1) if f"{stem}_{at}" not in taken)
            name = f"{stem}_{last[name]}"
        taken[name] = None
    return list(taken)


def _pose(
    local: dict[int, NDArray[np.float64]], parents: dict[int, int | None], number: int
) -> NDArray[np.float64] | None:
    """Matrix of a node to the world; None for the identity."""
    pose, above = local[number], parents[number]
    for _ in parents:
        if above is None:
            break
        pose, above = local[above] @ pose, parents[above]
    else:
        raise ValueError("nodes are their own parents")
    turn = pose[:3, :3]
    if 1e-13 < np.abs(turn @ turn.T - np.eye(3)).max() < 1e-5:
        # A turn that the file has rounded.
        before, _, after = np.linalg.svd(turn)
        rounded, pose = pose, np.eye(4)
        pose[:3, :3], pose[:3, 3] = before @ after, rounded[:3, 3]
    return None if np.array_equal(pose, np.eye(4)) else pose


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a .glb through trimesh, and .gltf, or a .glb with attributes or materials, without it."""
    if path.suffix.lower() == ".gltf":
        path.write_bytes(gltf.gltf_of(mesh))
        return
    if mesh.vertex_data or mesh.materials:
        path.write_bytes(gltf.glb_of(mesh))
        return
    trimesh = require_package("trimesh")
    name = utf8(mesh.name) or "mesh"
    content = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    scene = trimesh.Scene()
    scene.add_geometry(content, node_name=name, geom_name=name)
    path.write_bytes(scene.export(file_type=path.suffix[1:].lower()))
