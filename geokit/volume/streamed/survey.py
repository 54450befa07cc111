"""What one pass over a mesh's triangles tells: where it lies, whether it is closed, which way it is wound."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.streamed.windings import extent

# Odd constants with mixed bits, for hashes of three numbers and for two of an edge.
COLUMNS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
EDGES = np.array([0xD6E8FEB86659FD93, 0xA0761D6478BD642F], np.uint64)
MIX = np.array([0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)
# Volumes under this share of the area times the size cannot be told from rounding.
FLAT_SHARE = 1e-13


class Survey(NamedTuple):
    """What is known of a mesh after one pass.

    Attributes:
        face_count: Number of triangles.
        bounds: Their box, (2, 3).
        area: Sum of their areas [world^2].
        closed: Each edge is used as often in one direction as in the other. A mesh that is not closed is taken for one
            with a probability of 2^-128.
        inside_out: The volume is negative.
        sha256: Of the corners as they are in the file, in hexadecimal.
    """

    face_count: int
    bounds: NDArray[np.float64]
    area: float
    closed: bool
    inside_out: bool
    sha256: str


def survey(blocks: Iterable[NDArray[Any]]) -> Survey:
    """Look at the triangles (N, 3, 3) once.

    Source:
        Edges as a sum of hashes with signs: Bellare, Micciancio, "A New Paradigm for Collision-Free Hashing" (1997).
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    count, volume, area = 0, 0.0, 0.0
    edges = np.zeros(2, np.uint64)
    digest = hashlib.sha256()
    middle = None
    for block in blocks:
        digest.update(np.ascontiguousarray(block).data)
        corners = block.astype(np.float64)
        count += len(corners)
        lows, highs = extent(corners)
        low, high = np.minimum(low, _each(lows, np.min)), np.maximum(high, _each(highs, np.max))
        edges += _edge_sums(corners)
        # Near the origin of the coordinates volumes lose no digits.
        middle = corners[0].mean(axis=0) if middle is None else middle
        a, b, c = (corners[:, k] - middle for k in range(3))
        normal = np.cross(b - a, c - a)
        volume += float(np.einsum("ij,ij->", a, normal))
        area += float(np.linalg.norm(normal, axis=1).sum())
    size = float((high - low).max()) if count else 0.0
    inside_out = volume < -FLAT_SHARE * area * size
    return Survey(count, np.stack([low, high]), 0.5 * area, not edges.any(), inside_out, digest.hexdigest())


def _each(rows: NDArray[np.float64], of: Any) -> NDArray[np.float64]:
    """A reduction of each column of rows (N, 3): the whole table at once takes ten times as long."""
    return np.array([of(rows[:, k]) for k in range(3)])


def _edge_sums(corners: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Two sums of the hashes of all edges: an edge in the other direction is subtracted."""
    # Adding 0.0 makes 0.0 of -0.0.
    words = (corners + 0.0).view(np.uint64)
    x, y, z = (_mixed(words[:, :, k]) * factor for k, factor in enumerate(COLUMNS))
    place = _mixed(x + y + z)
    sums = np.zeros(2, np.uint64)
    for k in range(3):
        one, other = place[:, k], place[:, (k + 1) % 3]
        low, high = np.minimum(one, other), np.maximum(one, other)
        # In 64 bits these are 1, -1 and 0.
        turn = (one < other).astype(np.uint64) - (one > other).astype(np.uint64)
        edges = _mixed(low * EDGES[:, None] + high)
        sums += (edges * turn).sum(axis=1, dtype=np.uint64)
    return sums


def _mixed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Hashes of numbers.

    Source:
        Steele, Lea, Flood, "Fast Splittable Pseudorandom Number Generators" (2014): the mixing of SplitMix64.
    """
    mixed = numbers.copy()
    for shift, factor in zip((30, 27), MIX, strict=True):
        mixed ^= mixed >> np.uint64(shift)
        mixed *= factor
    return mixed ^ (mixed >> np.uint64(31))
