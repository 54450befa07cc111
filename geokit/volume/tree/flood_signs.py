"""Signs of a level set's empty regions, propagated from the faces of its leaves through the slots of its nodes.

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

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.host_array import HostArray
from geokit.volume.nanovdb.nodes import root_origins, slot_of
from geokit.volume.tree.grid_head import gaps_inside, root_keys_of, with_gaps
from geokit.volume.tree.typed_tree import Nodes, TypedTree


def with_signs(tree: TypedTree, inside: Any) -> TypedTree:
    """Add tiles of the value ``inside`` to a level set's tree of leaves, in the empty regions inside.

    Raises:
        InputError: The upper nodes are too far apart to fill the gaps between them.
    """
    if not len(tree.origins):
        return tree
    lower, lower_origins, faces = _level(tree, tree.origins, face_signs(tree.values), inside, 4, 8)
    upper, upper_origins, faces = _level(tree, lower_origins, faces, inside, 5, 128)
    keys = root_keys_of(upper_origins)
    order = np.argsort(keys)
    table, _, gaps = with_gaps(keys[order], True)
    rows = gaps_inside(gaps, faces[order])
    origins = root_origins(table[rows]).reshape(-1, 3)
    root = Nodes(origins, np.full(len(rows), inside, tree.values.dtype), np.zeros(len(rows), np.bool_))
    return replace(tree, lower=lower, upper=upper, root=root)


def _level(
    tree: TypedTree, children: NDArray[np.int32], faces: NDArray[np.uint8], inside: Any, bits: int, span: int
) -> tuple[Nodes, NDArray[np.int32], NDArray[np.uint8]]:
    """The nodes above some children: those with a tile inside, the origins of all, and their own faces."""
    from geokit.volume.tree.node_signs_kernels import INSIDE

    width = 1 << bits
    origins, node = np.unique(children & ~np.int32(width * span - 1), axis=0, return_inverse=True)
    states, own = flood(len(origins), bits, node.reshape(-1), slot_of(children, width, span), faces)
    some = np.flatnonzero((states == int(INSIDE)).any(axis=1))
    values = np.where(states[some] == int(INSIDE), inside, tree.background).astype(tree.values.dtype, copy=False)
    return Nodes(origins[some], values, np.zeros(values.shape, np.bool_)), origins, own


def face_signs(values: NDArray[Any]) -> NDArray[np.uint8]:
    """One bit for each face of leaves, -x +x -y +y -z +z, set if the voxel next to its middle lies inside.

    Args:
        values: Leaf values (L, 512), z fastest.
    """
    cube = values.reshape(-1, 8, 8, 8)
    picked = [
        cube[:, 0, 4, 4],
        cube[:, 7, 4, 4],
        cube[:, 4, 0, 4],
        cube[:, 4, 7, 4],
        cube[:, 4, 4, 0],
        cube[:, 4, 4, 7],
    ]
    return np.packbits(np.stack(picked, axis=1) < 0.0, axis=1, bitorder="little")[:, 0]


def flood(
    node_count: int, bits: int, node: NDArray[np.int64], slot: NDArray[np.int64], faces: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """States of the slots of nodes on the host, from the faces of their children.

    Args:
        node_count: Number of nodes N.
        bits: Logarithm of the slots along an axis of a node.
        node: Node of each child, shape (C,), each node at least once.
        slot: Slot of each child in its node, shape (C,), z fastest.
        faces: Faces of the children as of :func:`face_signs`, (C,).

    Returns:
        State of every slot (N, slots) as in node_signs_kernels, and the nodes' own faces (N,).
    """
    states, own = np.zeros(node_count << 3 * bits, np.uint8), np.empty(node_count, np.uint8)
    keys, ends = HostArray(slot.astype(np.int64, copy=False)), HostArray((node + 1).astype(np.int32))
    children, device = HostArray(np.ascontiguousarray(faces)), launcher.resolve_device("cpu")
    spread_signs(bits, keys, ends, children, HostArray(states), HostArray(own), device)
    return states.reshape(node_count, -1), own


def spread_signs(
    bits: int, keys: Any, ends: Any, faces: Any, out_states: Any, out_faces: Any, device: "wp.Device"
) -> None:
    """Write the states of the slots of nodes, and the nodes' own faces, on a device.

    Args:
        bits: Logarithm of the slots along an axis of a node.
        keys: Key of each child, whose last bits are its slot, (C,) of int64.
        ends: For each child, the number of nodes up to its own, (C,) of int32.
        faces: One bit for each face of the children, (C,) of uint8.
        out_states: (N * slots,) of uint8, zero before.
        out_faces: Faces of the nodes, (N,) of uint8.
        device: Device of the arrays.
    """
    from geokit.volume.tree import node_signs_kernels as kernels

    inputs = [keys, 3 * bits, ends, faces]
    launcher.launch(kernels.place_children_kernel, len(faces), inputs, [out_states], device)
    for axis in (2, 1, 0):
        launcher.launch(kernels.sweep_kernel, len(out_faces) << (2 * bits), [bits, axis], [out_states], device)
    launcher.launch(kernels.node_faces_kernel, len(out_faces), [bits, out_states], [out_faces], device)
