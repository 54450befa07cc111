"""Vertices written once for each set of values that their corners have."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_rows
from geokit.mesh.attributes.derived import derived, with_data
from geokit.mesh.model.data import Data
from geokit.mesh.model.triangle_mesh import TriangleMesh


def split_seams(mesh: TriangleMesh, names: Collection[str]) -> TriangleMesh:
    """The mesh with these corner attributes moved to its vertices.

    Vertices keep their numbers. Where the corners of a vertex differ, copies of it follow after all others. Vertices
    that no face uses get NaN, or 0 in integers.

    Args:
        mesh: The mesh.
        names: Names in its ``corner_data``; an attribute of vertices with such a name is replaced.
    """
    if not names:
        return mesh
    values = {name: mesh.corner_data[name] for name in names}
    first, group = distinct_corners(mesh.faces, values)
    owner = mesh.faces.reshape(-1)[first]
    # The first set of values that a vertex has keeps the vertex; all others are new ones.
    number = np.full(len(first), -1, np.int64)
    keeps = np.unique(owner, return_index=True)[1]
    number[keeps] = owner[keeps]
    copies = np.flatnonzero(number < 0)
    number[copies] = mesh.vertex_count + np.arange(len(copies))
    source = np.concatenate([np.arange(mesh.vertex_count), owner[copies]])
    moved = {}
    for name, given in values.items():
        flat = given.reshape(-1, *given.shape[2:])
        moved[name] = np.full((len(source), *flat.shape[1:]), np.nan if flat.dtype.kind == "f" else 0, flat.dtype)
        moved[name][number] = flat[first]
    split = derived(mesh, mesh.vertices[source], number[group].reshape(-1, 3), vertex_source=source)
    rest = {name: given for name, given in mesh.corner_data.items() if name not in names}
    return with_data(split, vertex_data={**split.vertex_data, **moved}, corner_data=rest)


def distinct_corners(numbers: NDArray[Any] | None, values: Data) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Corners that differ in their number or in a value, to the bit, in order of first appearance.

    Args:
        numbers: A number of each corner, such as its vertex, (F, 3); None where only the values count.
        values: Arrays on corners, (F, 3) or (F, 3, k).
    Returns:
        ``first`` (U,): a corner of each kind, and ``group`` (3 F,): the kind of each corner, as of
        :func:`geokit.core.equal_rows.merge_equal_rows`.
    """
    count = numbers.size if numbers is not None else len(next(iter(values.values()))) * 3
    group = np.zeros(count, np.int64) if numbers is None else numbers.reshape(-1).astype(np.int64)
    first, group = merge_equal_rows(np.stack([group] * 3, axis=1)) if numbers is not None else (None, group)
    for given in values.values():
        columns = given.reshape(count, -1)
        for begin in range(0, columns.shape[1], 2):
            pair = [_bits(column) for column in columns[:, begin : begin + 2].T]
            first, group = merge_equal_rows(np.stack([group, *pair, *[pair[0]] * (2 - len(pair))], axis=1))
    assert first is not None
    return first, group


def _bits(column: NDArray[Any]) -> NDArray[np.int64]:
    if column.dtype.kind != "f":
        return column.astype(np.int64)
    # Widening is exact, and different numbers stay different.
    return np.ascontiguousarray(column, np.float64).view(np.int64)
