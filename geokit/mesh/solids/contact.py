"""Chooses how far bodies move so that what touches but for rounding is one, with no skin or slit left there."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.sign.left_out import CONTACT
from geokit.mesh.solids.judging import areas_of
from geokit.mesh.solids.pieces import Pieces, inflated

# Bodies move by the first of these shares of the size that joins what touches but for the rounding of float64, or of
# float32, else by CONTACT.
MOVES = (1e-9, 1e-7)
# Smallest contact that is looked for, as a share of the bodies' area.
LEAST_CONTACT = 1e-6


def within_contact(
    make: Callable[[NDArray[np.float64]], Pieces | None],
    verdict: Callable[[Pieces, float], str],
    positions: NDArray[np.float64],
    corners: NDArray[Any],
    size: float,
    near: Callable[[float], bool],
    sign: float = 1.0,
) -> tuple[Pieces | None, str]:
    """What bodies ``make`` together, and why it is not right by the ``verdict``, "" if it is; None if nothing is.

    Args:
        positions: Vertices of all bodies, of which no two share one [world] (V, 3).
        corners: Corners of the faces of those bodies that may move (F, 3).
        near: Whether faces of two bodies may face each other so far apart [world]. If not, there is most likely nothing
            to join; the verdict decides.
        sign: 1 where they grow, -1 where they shrink.
    """

    def made(share: float) -> Pieces | None:
        return make(inflated(positions, corners, sign * share * size) if share else positions)

    as_given = made(0.0)
    # Each of two faces moves by CONTACT at most; the rest is for rounding.
    if as_given is not None and not near(2.5 * CONTACT * size) and not verdict(as_given, 0.0):
        return as_given, ""
    moved = made(CONTACT)
    # Where bodies touch but for rounding, both sides of the contact are there until they move together.
    before, after = (
        areas_of(places, corners) for places in (positions, inflated(positions, corners, sign * CONTACT * size))
    )
    slack = 4.0 * np.abs(after - before).sum() + LEAST_CONTACT * before.sum()

    def joins(pieces: Pieces | None) -> bool:
        """Whether bodies that move as far as CONTACT would join no further."""
        if pieces is None or moved is None:
            return pieces is not None
        return areas_of(pieces.vertices, pieces.faces).sum() - areas_of(moved.vertices, moved.faces).sum() <= slack

    tries = itertools.chain([(as_given, 0.0)], ((made(share), share) for share in MOVES), [(moved, CONTACT)])
    joined = next((one for one in tries if joins(one[0])), (moved, CONTACT))
    candidates = [joined, *(one for one in ((moved, CONTACT), (as_given, 0.0)) if one[1] != joined[1])]
    best, kept = None, "their union could not be made"
    for pieces, share in candidates:
        found = "wrong" if pieces is None else verdict(pieces, share * size)
        if not found:
            return pieces, ""
        if found == "walls" and best is None:
            best, kept = pieces, "some of it is left in their union"
    return best, kept
