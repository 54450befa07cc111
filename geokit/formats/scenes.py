"""Scenes in .glb and .gltf, through trimesh, which reads in a separate process."""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from geokit._packages import require_package
from geokit.core.files import refuse_pointer
from geokit.errors import FileFormatError
from geokit.formats.attributes import gltf
from geokit.formats.attributes.columns import utf8
from geokit.formats.body import Body, FileMaterial
from geokit.formats.references import LONGEST, require_inside
from geokit.formats.scene_content.gltf import is_animated, require_whole, understood

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["holds_texture", "holds_type", "prepare", "read_mesh", "write_mesh"]


def prepare() -> None:
    """Import trimesh and have it do what it does once, with the first file of a format."""
    import trimesh

    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False, validate=False)
    triangle.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name="0"))
    scene = trimesh.Scene(triangle)
    trimesh.load_scene(io.BytesIO(scene.export(file_type="glb")), file_type="glb", process=False)


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read each mesh at each of its places in the scene graph; nothing is merged.

    Skins and morph targets have the pose of the file's nodes and weights; animations are left out, with a note.
    Attributes are those of the file; materials have a name, a base color and its texture. Buffers and images in other
    files are read from the file's own folder and from ``folders``.
    """
    require_package("trimesh")
    import trimesh

    class Folders(trimesh.resolvers.Resolver):
        """Opens all files for trimesh that the scene refers to."""

        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            # References are URIs, in which a space is %20; many programs write plain names.
            names = dict.fromkeys([key, unquote(key)])
            for name in names:
                found = require_inside(key, path.parent / name, path, folders)
                if os.path.exists(found):
                    refuse_pointer(found)
                    return found.read_bytes()
            raise FileFormatError(f"{path}: refers to {key[:LONGEST]!r}, which is missing; get it too")

        def keys(self) -> list[str]:
            return []

        def namespaced(self, namespace: str) -> Folders:
            return self

        def write(self, name: str, data: Any) -> None:
            raise NotImplementedError

    # merge_primitives stays off: each primitive keeps its own vertices, as in the file.
    kind = path.suffix.lower()
    restored = understood(path, Folders().get)
    source: dict[str, Any] = {"file_obj": str(path)}
    if restored is not None:
        source = {"file_obj": io.BytesIO(restored), "file_type": kind[1:]}
    materials: tuple[FileMaterial, ...] = ()
    notes: tuple[str, ...] = ()
    # What is not understood here is left to trimesh, which says why.
    with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, struct.error):
        header, chunks = gltf.split_header(path.read_bytes() if restored is None else restored)
        content = gltf.renamed(header, chunks, binary=kind == ".glb")
        materials, notes = gltf.materials_of(header, chunks, Folders().get)
        notes = tuple(note.replace(f"{path}: ", "") for note in notes)
        if is_animated(header):
            notes += ("its animations are left out: it is read as it stands without them",)
        source = {"file_obj": io.BytesIO(content), "file_type": kind[1:]}
    try:
        scene = trimesh.load_scene(**source, process=False, resolver=Folders())
    except (AssertionError, ValueError):  # which do not say what is missing
        with contextlib.suppress(ValueError, TypeError, IndexError):
            require_whole(path, Folders().get)
        raise
    bodies: list[Body] = []
    others = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh):
            others.append(type(geometry).__name__)
        elif len(geometry.faces):
            bodies.append(_body(geometry, np.asarray(matrix, np.float64), str(node), len(materials)))
    if not bodies:
        what = f"only {', '.join(sorted(set(others)))}" if others else "no geometry with faces"
        raise FileFormatError(f"{path}: holds {what}; a mesh needs faces, export the surface itself")
    for kind, what in (("Path3D", "lines"), ("PointCloud", "points")):
        if count := others.count(kind):
            notes += (f"its {what} (of {count} {'primitive' if count == 1 else 'primitives'}) are left out",)
    # The specification fixes both.
    bodies[0] = bodies[0]._replace(materials=materials, notes=notes, meters_per_unit=1.0, up_axis="y")
    return bodies


def _body(geometry: Any, matrix: np.ndarray, name: str, material_count: int) -> Body:
    faces = np.ascontiguousarray(geometry.faces, np.int64)
    return Body(
        np.ascontiguousarray(geometry.vertices, np.float64),
        np.full(len(faces), 3),
        faces.ravel(),
        name=name,
        transform=None if np.array_equal(matrix, np.eye(4)) else matrix,
        vertex_data=gltf.attributes_of(geometry.vertex_attributes),
        polygon_data=_material(geometry, len(faces), material_count),
    )


def _material(geometry: Any, face_count: int, material_count: int) -> dict[str, np.ndarray]:
    """The number of the material on each face, which is its name in :func:`gltf.renamed`; nothing without materials."""
    name = str(getattr(getattr(geometry.visual, "material", None), "name", None))
    known = name.isdigit() and int(name) < material_count
    return {"material": np.full(face_count, int(name), np.int32)} if known else {}


def holds_type(values: np.ndarray, _kind: str) -> bool:
    """As glTF does."""
    return gltf.holds_type(values)


def holds_texture(data: bytes) -> bool:
    """As glTF does."""
    return gltf.holds_texture(data)


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
