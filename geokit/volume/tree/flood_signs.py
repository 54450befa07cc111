"""Signs of a level set's empty regions, propagated from the faces of its leaves through the tables of its nodes.

A narrow band keeps every sign change inside its leaves, so a slot without a child lies on one side, which the touching
face of any neighbor shows. One sweep each along z, y and x reaches every slot of a node that has a child.

Source:
    OpenVDB's signedFloodFill. Differs: all nodes of a level are processed at once, and every face passes on its own
        sign, where OpenVDB passes on that of a node's last voxel.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.nodes import root_origins, slot_of
from geokit.volume.tree.root_table import root_keys_of, with_gaps
from geokit.volume.tree.typed_tree import Nodes, TypedTree

__all__ = ["with_signs"]

# Axis and side of a node's faces; side 0 is the lower one.
FACES = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1))
# Nodes processed together: with their faces 512 upper nodes would be 120 MB.
LOWER_AT_A_TIME, UPPER_AT_A_TIME = 512, 64


def with_signs(tree: TypedTree, inside: Any) -> TypedTree:
    """Add tiles of the value ``inside`` to a level set's tree of leaves, in the empty regions inside.

    Raises:
        InputError: The upper nodes are too far apart to fill the gaps between them.
    """
    if not len(tree.origins):
        return tree
    lower, lower_origins, faces = _level(tree, tree.origins, face_signs(tree.values), inside, 16, 8, LOWER_AT_A_TIME)
    upper, upper_origins, faces = _level(tree, lower_origins, faces, inside, 32, 128, UPPER_AT_A_TIME)
    keys = root_keys_of(upper_origins)
    order = np.argsort(keys)
    table, _, gaps = with_gaps(keys[order], True)
    # The gap lies inside if both its ends along z do: faces 5 (upper z) and 4 (lower z).
    rows = [row for row, below, above in gaps if faces[order[below], 5] < 0 and faces[order[above], 4] < 0]
    origins = root_origins(table[rows]).reshape(-1, 3)
    root = Nodes(origins, np.full(len(rows), inside, tree.values.dtype), np.zeros(len(rows), np.bool_))
    return replace(tree, lower=lower, upper=upper, root=root)


def _level(
    tree: TypedTree,
    children: NDArray[np.int32],
    faces: NDArray[np.int8],
    inside: Any,
    width: int,
    span: int,
    at_a_time: int,
) -> tuple[Nodes, NDArray[np.int32], NDArray[np.int8]]:
    """The nodes above some children: those with a tile inside, the origins of all, and the signs of their faces."""
    origins, node = np.unique(children & ~np.int32(width * span - 1), axis=0, return_inverse=True)
    order = np.argsort(node.reshape(-1), kind="stable")
    node = node.reshape(-1)[order]
    slot, faces = slot_of(children[order], width, span), faces[order]
    own = np.empty((len(origins), 6), np.int8)
    found = [Nodes.none(tree.layout, width**3)]
    for first in range(0, len(origins), at_a_time):
        stop = min(first + at_a_time, len(origins))
        part = slice(*np.searchsorted(node, [first, stop]))
        signs, own[first:stop] = flood(stop - first, width, node[part] - first, slot[part], faces[part])
        some = np.flatnonzero((signs < 0).any(axis=1))
        values = np.where(signs[some] < 0, inside, tree.background).astype(tree.values.dtype, copy=False)
        found.append(Nodes(origins[first + some], values, np.zeros(values.shape, np.bool_)))
    return Nodes.joined(found), origins, own


def face_signs(values: NDArray[Any]) -> NDArray[np.int8]:
    """Sign on each face of each leaf, read at the voxel next to the middle of the face.

    Args:
        values: Leaf values (L, 512), z fastest.

    Returns:
        -1 or 1, shape (L, 6), in the order of :data:`FACES`.
    """
    cube = values.reshape(-1, 8, 8, 8)
    middle = 4
    picked = [
        cube[:, 0, middle, middle], cube[:, 7, middle, middle],
        cube[:, middle, 0, middle], cube[:, middle, 7, middle],
        cube[:, middle, middle, 0], cube[:, middle, middle, 7],
    ]  # fmt: skip
    return np.where(np.stack(picked, axis=1) < 0.0, np.int8(-1), np.int8(1))


def flood(
    node_count: int, width: int, node: NDArray[np.int64], slot: NDArray[np.int64], faces: NDArray[np.int8]
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Signs of the slots of nodes, from the faces of their children.

    Args:
        node_count: Number of nodes N.
        width: Slots along each axis of a node.
        node: Node of each child, shape (C,), each node at least once.
        slot: Slot of each child in its node, shape (C,), z fastest.
        faces: Signs of the children's faces (C, 6).

    Returns:
        Sign of every slot (N, width^3), 0 where there is a child, and the signs of the nodes' own faces (N, 6).
    """
    shape = (node_count, width, width, width)
    open_slots = np.ones((node_count, width**3), np.bool_)
    open_slots[node, slot] = False
    unknown = open_slots.reshape(shape)
    signs = np.zeros(shape, np.int8)
    # A neighbor sees the tile's sign, or the child's face on its side; the other of the two is zero.
    shown = np.zeros((6, node_count, width**3), np.int8)
    shown[:, node, slot] = faces.T
    shown = shown.reshape(6, *shape)
    for axis in (2, 1, 0):
        _sweep(signs, unknown, shown[2 * axis + 1], axis, range(1, width), -1)
        _sweep(signs, unknown, shown[2 * axis], axis, range(width - 2, -1, -1), 1)
    own = np.empty((node_count, 6), np.int8)
    middle = width // 2
    for face, (axis, side) in enumerate(FACES):
        place: list[slice | int] = [slice(None), middle, middle, middle]
        place[1 + axis] = side * (width - 1)
        own[:, face] = signs[tuple(place)] + shown[face][tuple(place)]
    return signs.reshape(node_count, -1), own


def _sweep(
    signs: NDArray[np.int8], unknown: NDArray[np.bool_], shown: NDArray[np.int8], axis: int, steps: range, back: int
) -> None:
    sign, open_slot, face = (np.moveaxis(array, axis + 1, 0) for array in (signs, unknown, shown))
    for i in steps:
        new = (sign[i + back] + face[i + back]) * open_slot[i]
        sign[i] += new
        open_slot[i] &= new == 0
