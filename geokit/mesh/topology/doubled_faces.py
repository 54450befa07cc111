"""Finds faces that lie back to back: the same three positions, wound in opposite directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["DoubledFaces", "back_to_back_pairs", "doubled_faces", "none_doubled"]


class DoubledFaces(NamedTuple):
    """Copies of faces that lie back to back on closed components.

    Such faces cancel in a winding number. A component of faces that each count once is what the file means.

    Attributes:
        copies: Rows of the faces that repeat an earlier one, (R,), ascending.
        piece: Component of each, (R,).
        whole: Whether all faces of that component are doubled, (R,) bool.
    """

    copies: NDArray[np.int64]
    piece: NDArray[np.int32]
    whole: NDArray[np.bool_]


def none_doubled() -> DoubledFaces:
    return DoubledFaces(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, bool))


def back_to_back_pairs(
    corners: NDArray[np.int32], repeats: NDArray[np.int64], repeated: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The faces with copies in both directions, and the number of pairs that each of them makes.

    Args:
        corners: Corners of the faces as numbers of positions, (F, 3).
        repeats: Faces that repeat an earlier one, from ``repeated_triples``.
        repeated: The earliest equal face of each.
    """
    one, other = corners[repeats], corners[repeated]
    alike = np.zeros(len(repeats), bool)
    for shift in range(3):
        alike |= (one == np.roll(other, shift, axis=1)).all(axis=1)
    first, group = np.unique(repeated, return_inverse=True)
    along = 1 + np.bincount(group, alike, minlength=len(first)).astype(np.int64)
    against = np.bincount(group, ~alike, minlength=len(first)).astype(np.int64)
    both = against > 0
    return first[both], np.minimum(along, against)[both]


def doubled_faces(
    corners: NDArray[np.int32],
    repeats: NDArray[np.int64],
    repeated: NDArray[np.int64],
    label: NDArray[np.int32],
    closed: NDArray[np.bool_],
) -> DoubledFaces:
    """The copies of faces that lie back to back on closed components.

    Args:
        corners: Corners of the faces, (F, 3).
        repeats: Faces that repeat an earlier one.
        repeated: The earliest equal face of each.
        label: Component of each face but the repeats, (F - R,), found without them.
        closed: Components that bound a volume, (count,).
    """
    first, _ = back_to_back_pairs(corners, repeats, repeated)
    if not len(first):
        return none_doubled()
    piece_of = np.full(len(corners), -1, np.int32)
    piece_of[np.delete(np.arange(len(corners)), repeats)] = label
    whole = np.bincount(piece_of[first], minlength=len(closed)) == np.bincount(label, minlength=len(closed))
    piece = piece_of[repeated]
    chosen = np.isin(repeated, first) & closed[piece]
    return DoubledFaces(repeats[chosen], piece[chosen], whole[piece[chosen]])
