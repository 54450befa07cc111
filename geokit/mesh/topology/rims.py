"""Rims: the edges of a mesh that only one face has, one after the other around each hole."""

from __future__ import annotations

from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.topology.connectivity import Topology, next_half_edge

__all__ = ["Rims", "edges_within", "find_rims"]


class Rims(NamedTuple):
    """The rims of a mesh.

    Attributes:
        half_edges: Half-edges of all rims, in the direction of their faces, rim after rim (R,).
        begin: Where each rim begins in ``half_edges``, and their number (H + 1,).
        is_loop: Whether each rim is a loop that meets no position twice; False for a chain that ends at an edge of more
            than two faces, or of two faces that are wound against each other (H,).
    """

    half_edges: NDArray[np.int64]
    begin: NDArray[np.int64]
    is_loop: NDArray[np.bool_]


def find_rims(topology: Topology) -> Rims:
    """The rims of a mesh. Where one meets a position again, what lies between is a rim of its own."""
    border = topology.order[topology.starts[topology.uses == 1]].astype(np.int64)
    row = np.full(len(topology.order), -1)
    row[border] = np.arange(len(border))
    across = topology.twin.copy()
    for alike in topology.pairs:
        across[alike[~topology.opposed]] = -1
    # Around the end of each half-edge, from face to face, to where the fan ends.
    last = next_half_edge(border)
    inside = np.arange(len(border))
    while len(inside):
        over = across[last[inside]]
        inside, over = inside[over >= 0], over[over >= 0]
        last[inside] = next_half_edge(over)
    follower = row[last]
    is_followed = np.zeros(len(border), bool)
    is_followed[follower[follower >= 0]] = True
    rims = _walks(follower.tolist(), np.flatnonzero(~is_followed).tolist(), topology.start[border].tolist())
    sizes = [len(rim) for rim, _ in rims]
    rows = np.fromiter(chain.from_iterable(rim for rim, _ in rims), np.int64, sum(sizes))
    return Rims(border[rows], np.cumsum([0, *sizes]), np.array([is_loop for _, is_loop in rims], bool))


def edges_within(topology: Topology, begin: NDArray[np.int64], position: NDArray[Any]) -> NDArray[np.int64]:
    """Edges between two points of one rim that are no sides of it: two rows of the rims, in both orders (K, 2).

    They are ascending by their first row. ``position`` is where the rims' half-edges start (R,), as numbered by the
    topology; each rim begins in it at ``begin`` (H + 1,).
    """
    sizes = np.diff(begin)
    rim = np.repeat(np.arange(len(sizes)), sizes)
    position = position.astype(np.int64)
    code = position * len(sizes) + rim
    order = np.argsort(code)
    count = np.bincount(position, minlength=topology.position_count)
    edge = topology.order[topology.starts]
    ends = np.stack([topology.start[edge], topology.start[next_half_edge(edge)]], axis=1)
    ends = ends[(count[ends] > 0).all(axis=1)]
    ends = np.concatenate([ends, ends[:, ::-1]])
    # Each rim of the first end is one that the second may have too.
    times = count[ends[:, 0]]
    first = np.searchsorted(position[order], ends[:, 0])
    within = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    one = order[np.repeat(first, times) + within]
    sought = np.repeat(ends[:, 1], times) * len(sizes) + rim[one]
    at = np.minimum(np.searchsorted(code[order], sought), len(order) - 1)
    other = order[at]
    apart = (other - one) % sizes[rim[one]]
    found = (code[other] == sought) & (apart > 1) & (apart < sizes[rim[one]] - 1)
    pairs = np.stack([one, other], axis=1)[found]
    return pairs[np.argsort(pairs[:, 0], kind="stable")]


def _walks(follower: list[int], heads: list[int], position: list[int]) -> list[tuple[list[int], bool]]:
    """Rows from each to its follower, -1 where there is none, and whether each walk is a loop; chains from heads."""
    rims: list[tuple[list[int], bool]] = []
    taken = [False] * len(follower)
    for head in chain(heads, range(len(follower))):
        walk: list[int] = []
        place: dict[int, int] = {}
        row = head
        while row >= 0 and not taken[row]:
            taken[row] = True
            begin = place.get(position[row], len(walk))
            if begin < len(walk):
                rims.append((walk[begin:], True))
                for between in walk[begin:]:
                    del place[position[between]]
                del walk[begin:]
            place[position[row]] = len(walk)
            walk.append(row)
            row = follower[row]
        if walk:
            rims.append((walk, row == head))
    return rims
