"""Meshes with an attribute of each kind, whose values say which vertex, face or corner they belong to."""

from __future__ import annotations

import numpy as np

import geokit as gk

__all__ = ["PNG", "numbered", "painted"]

# One white pixel.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63f8ffff3f0005fe02fe"
    "0def46b80000000049454e44ae426082"
)


def numbered(mesh: gk.mesh.TriangleMesh) -> gk.mesh.TriangleMesh:
    """The mesh with numbers of its vertices, faces and corners, in one and in two columns, and of several types."""
    v, f = np.arange(mesh.vertex_count), np.arange(mesh.face_count)
    c = (3 * f[:, None] + np.arange(3)).astype(np.float32)
    return gk.mesh.TriangleMesh(
        mesh.vertices,
        mesh.faces,
        name=mesh.name,
        parts=mesh.parts,
        vertex_data={"v": v.astype(np.int16), "v2": np.stack([v, v + 0.5], axis=1)},
        face_data={"f": f.astype(np.uint8), "f2": np.stack([f, -f], axis=1).astype(np.float32)},
        corner_data={"c": c, "c2": np.stack([c, c / 3], axis=2).astype(np.float64)},
        materials=(gk.mesh.Material("a"), gk.mesh.Material("b")),
        meters_per_unit=0.001,
    )


def painted(mesh: gk.mesh.TriangleMesh, seed: int = 0) -> gk.mesh.TriangleMesh:
    """The mesh with normals, colors and materials, and texture coordinates that differ at the corners of a vertex."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=(mesh.vertex_count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return gk.mesh.TriangleMesh(
        mesh.vertices,
        mesh.faces,
        name=mesh.name,
        vertex_data={
            "normal": normal.astype(np.float32),
            "color": random.integers(0, 256, (mesh.vertex_count, 4)).astype(np.uint8),
        },
        face_data={"material": (np.arange(mesh.face_count) % 2).astype(np.int32)},
        corner_data={"uv": np.round(random.random((mesh.face_count, 3, 2)), 1).astype(np.float32)},
        materials=(
            gk.mesh.Material("red", (1.0, 0.25, 0.0, 1.0)),
            gk.mesh.Material("wood", None, gk.mesh.Texture("wood.png", PNG)),
        ),
    )
