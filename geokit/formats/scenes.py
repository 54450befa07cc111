"""Scenes in .glb, .gltf and .3mf, through trimesh, which reads in a separate process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.errors import FileFormatError
from geokit.formats.body import Body

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "write_mesh"]


def read_mesh(path: Path) -> list[Body]:
    """Read each mesh at each of its places in the scene graph; nothing is merged, textures are left out."""
    import trimesh

    # merge_primitives stays off: each primitive keeps its own vertices, as in the file.
    scene = trimesh.load_scene(str(path), process=False, skip_materials=True)
    bodies, others = [], []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh):
            others.append(type(geometry).__name__)
        elif len(geometry.faces):
            bodies.append(_body(geometry, np.asarray(matrix, np.float64), str(node)))
    if not bodies:
        what = f"only {', '.join(sorted(set(others)))}" if others else "no geometry with faces"
        raise FileFormatError(f"{path}: holds {what}; a mesh needs faces, export the surface itself")
    return bodies


def _body(geometry: Any, matrix: np.ndarray, name: str) -> Body:
    faces = np.ascontiguousarray(geometry.faces, np.int64)
    return Body(
        np.ascontiguousarray(geometry.vertices, np.float64),
        np.full(len(faces), 3),
        faces.ravel(),
        name=name,
        transform=None if np.array_equal(matrix, np.eye(4)) else matrix,
    )


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write .glb and .3mf through trimesh, one node for each part."""
    import trimesh

    name = mesh.name or "mesh"
    content = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    scene = trimesh.Scene()
    scene.add_geometry(content, node_name=name, geom_name=name)
    path.write_bytes(scene.export(file_type=path.suffix[1:].lower()))
