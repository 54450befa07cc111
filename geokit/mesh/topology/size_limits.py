"""Limits on the size of meshes, so that distances stay within the range of float64."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.core.frame import Frame
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Sizes as half of the bounding box's longest side. Queries multiply four lengths; a result outside float64's 1e-308 to
# 1e308 becomes 0, inf or NaN (tests/accuracy/stability/test_envelopes.py).
LEAST_SCALE, LARGEST_SCALE = 1e-71, 1e71


def require_measurable(mesh: TriangleMesh, frame: Frame) -> None:
    """Refuse distance queries for mesh sizes at which products of lengths leave the range of float64.

    Raises:
        InputError: The mesh is too small or too large.
    """
    if not LEAST_SCALE <= frame.scale <= LARGEST_SCALE:
        raise InputError(
            f"mesh: {mesh.name or 'it'} is {2.0 * frame.scale:.3g} across; scale it to between {LEAST_SCALE:g} and "
            f"{LARGEST_SCALE:g}: beyond, products of lengths leave float64"
        )
