"""Meshes in Gmsh .msh and .xdmf, through meshio. Runs in the reader process."""

from __future__ import annotations

import numpy as np

from geokit.formats.mesh_reader_worker import Refusal, WireBody

__all__ = ["read"]

_SURFACE = {"triangle", "quad", "polygon"}
# meshio's dimensions of second-order cells are right; the cells themselves are no polygons.
_IGNORED_DIMENSIONS = (0, 1)


def read(path: str) -> list[WireBody]:
    """The triangles, quads and polygons of the file; points, lines and the inner volume cells are left out."""
    import meshio

    mesh = meshio.read(path)
    counts: list[np.ndarray] = []
    indices: list[np.ndarray] = []
    volume: dict[str, int] = {}
    for block in mesh.cells:
        if block.type in _SURFACE:
            rows = [np.asarray(row, np.int64) for row in block.data] if block.type == "polygon" else block.data
            counts.append(np.fromiter(map(len, rows), np.int64, len(rows)))
            indices.append(np.concatenate(rows) if len(rows) else np.zeros(0, np.int64))
        elif block.dim == 2:
            raise Refusal(f"holds '{block.type}' cells, which are not polygons; export first-order triangles or quads")
        elif block.dim not in _IGNORED_DIMENSIONS:
            volume[block.type] = volume.get(block.type, 0) + len(block.data)
    if not counts:
        what = ", ".join(f"{count} {kind}" for kind, count in volume.items()) or f"{len(mesh.points)} points"
        raise Refusal(f"holds {what} but no surface cells; extract the surface and export that")
    points = np.asarray(mesh.points, np.float64)
    if points.shape[1] == 2:
        points = np.pad(points, ((0, 0), (0, 1)))
    return [
        WireBody(
            name="",
            arrays=(
                ("<f8", np.ascontiguousarray(points, "<f8").tobytes()),
                ("<i8", np.concatenate(counts).astype("<i8").tobytes()),
                ("<i8", np.concatenate(indices).astype("<i8").tobytes()),
            ),
        )
    ]
