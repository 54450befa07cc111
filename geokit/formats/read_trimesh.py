"""Scenes in .glb, .gltf and .3mf, through trimesh. Runs in the reader process."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.formats.mesh_reader_worker import Refusal, WireBody

__all__ = ["read"]


def read(path: str) -> list[WireBody]:
    """Each mesh at each place of the scene graph where it stands; nothing is merged, textures are left out."""
    import trimesh

    # merge_primitives stays off: each primitive keeps its own vertices, as in the file.
    scene = trimesh.load_scene(path, process=False, skip_materials=True)
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
        raise Refusal(f"holds {what}; a mesh needs faces, export the surface itself")
    return bodies


def _body(geometry: Any, matrix: np.ndarray, name: str) -> WireBody:
    faces = np.ascontiguousarray(geometry.faces, "<i8")
    identity = bool(np.array_equal(matrix, np.eye(4)))
    return WireBody(
        name=name,
        arrays=(
            ("<f8", np.ascontiguousarray(geometry.vertices, "<f8").tobytes()),
            ("<i8", np.full(len(faces), 3, "<i8").tobytes()),
            ("<i8", faces.tobytes()),
        ),
        transform=None if identity else matrix.ravel().tolist(),
    )
