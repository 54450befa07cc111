"""Least distance of two surfaces, one of which may have been moved."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.snapshot import snapshot
from geokit.core.interop.user_arrays import LARGEST_MEASURED
from geokit.core.poses.move import move
from geokit.core.query.ask import query
from geokit.core.require import require_affine, require_one_world
from geokit.errors import InputError
from geokit.mesh.queries.overlaps import LEAF_GRAIN, OverlapQueries, require_surface
from geokit.mesh.topology.size_limits import require_measurable

if TYPE_CHECKING:
    import warp as wp

__all__ = ["DistanceQueries", "SurfaceDistance"]

# Corners that give the first bound. More cost more than their bound saves.
BOUND_CORNERS = 512


class SurfaceDistance(NamedTuple):
    """Least distance of two surfaces, and where it is.

    Attributes:
        distance: The least distance [world].
        point: Where it is on the first surface [world], shape (3,).
        other_point: Where it is on the other one [world], shape (3,).
        triangle_id, other_triangle_id: The triangles that these lie on.
    """

    distance: float
    point: NDArray[np.float64]
    other_point: NDArray[np.float64]
    triangle_id: int
    other_triangle_id: int


class DistanceQueries(OverlapQueries):
    """Distances of a :class:`geokit.mesh.Surface` from others."""

    @query(memory=lambda self, *_, **__: 80 * self.mesh.face_count)
    def distance(self, other: OverlapQueries, *, transform: ArrayLike | None = None) -> SurfaceDistance:
        """Least distance from another surface: the clearance of two bodies, and the two points where it is.

        Exact for float64 triangles, to 1e-12 of the size of the two; with a ``transform``, for corners that were moved
        and rounded to float64. Whether the surfaces meet is decided exactly: the distance is 0 then, and only then
        (touching counts), and both points are one that they have in common. Ties go to the lowest triangle_id, then to
        the lowest other_triangle_id.

        Only the surfaces count: the distance of a body that is wholly inside another is not 0. How deep a body reaches
        into another is told by :meth:`signed_distance`. Faster if this surface has fewer triangles than the other one;
        slowest where two dense surfaces are as near to each other everywhere.

        Args:
            other: A surface on the same device.
            transform: Where this surface is: an affine map of it for column vectors, shape (4, 4), with the last row
                0, 0, 0, 1. It may change the unit and the axis that is up. None leaves it in place. No new tree is
                built.
        Returns:
            SurfaceDistance with distance, point (3,), other_point (3,), triangle_id, other_triangle_id.
        Raises:
            InputError: other is not a Surface, or is on another device; units or up axes are known and differ, without
                a transform; that has another shape or last row or a number that is not finite, or moves a corner
                beyond 1e150; a mesh is smaller than 1e-70 or larger than 1e70.
            DeviceMemoryError: The device cannot hold the moved corners.
        Source:
            Ericson, Real-Time Collision Detection (2005), 5.1.10. Differs: contact is decided by the predicates of
            :meth:`intersecting_triangles`, and edges that are nearly parallel keep their digits.
        Example:
            >>> low = gk.mesh.Surface(gk.mesh.sphere(radius=1.0), device="cpu")
            >>> high = gk.mesh.Surface(gk.mesh.box(size=(8, 8, 1), center=(0, 0, 5)), device="cpu")
            >>> round(low.distance(high).distance, 9)
            3.5
        """
        import warp as wp

        from geokit.mesh.queries.distance_kernels import (
            bound_by_corners_kernel,
            nearest_pair_kernel,
            points_of_pair_kernel,
        )

        other = snapshot(require_surface(self, other))
        if transform is None:
            require_one_world(surface=self.mesh, other=other.mesh)
        require_measurable(self.mesh, self._frame)
        require_measurable(other.mesh, other._frame)
        corners, scale = self._moved_corners(transform)
        device, tree, slots = self._device, other._tree, self._tree.slot_triangle
        # A power of two scales without rounding; unscaled, products of corners could underflow.
        unit = wp.float64(2.0 ** -round(math.log2(max(scale, other._frame.scale))))
        stride = -(-len(slots) // BOUND_CORNERS)
        bound = wp.array([np.float64(np.inf).view(np.int64)], dtype=wp.int64, device=device)
        inputs = [corners, slots, stride, tree, unit]
        launcher.launch(bound_by_corners_kernel, -(-len(slots) // stride), inputs, [bound], device, grain=LEAF_GRAIN)
        squared = wp.empty(self._leaf_count, dtype=wp.float64, device=device)
        pairs = wp.empty(2 * self._leaf_count, dtype=wp.int32, device=device)
        inputs = [corners, slots, tree, other._slot_boxes, unit]
        outputs = [bound, squared, pairs]
        launcher.launch(nearest_pair_kernel, self._leaf_count, inputs, outputs, device, grain=LEAF_GRAIN)
        found = squared.numpy()
        least = float(found.min())
        tied = pairs.numpy().reshape(-1, 2)[found == least]
        triangles = np.stack([slots.numpy()[tied[:, 0]], tree.slot_triangle.numpy()[tied[:, 1]]], axis=1)
        first = int(np.lexsort((triangles[:, 1], triangles[:, 0]))[0])
        points = wp.empty(2, dtype=wp.vec3d, device=device)
        slot, other_slot = (int(number) for number in tied[first])
        launcher.launch(points_of_pair_kernel, 1, [corners, slot, tree, other_slot, unit], [points], device)
        point, other_point = points.numpy().astype(np.float64)
        distance = math.sqrt(least) / float(unit)
        return SurfaceDistance(distance, point, other_point, int(triangles[first, 0]), int(triangles[first, 1]))

    def _moved_corners(self, transform: ArrayLike | None) -> tuple["wp.array", float]:
        """The corners of the slots where the map places them, and half the longest side of a box around them."""
        corners, scale = self._tree.corners, self._frame.scale
        if transform is None:
            return corners, scale
        matrix = require_affine(transform, "transform")
        linear, shift = matrix[:3, :3], matrix[:3, 3]
        with np.errstate(over="ignore", invalid="ignore"):
            center = linear @ self._frame.origin + shift
            half = np.abs(linear) @ np.full(3, scale)
            far = float((np.abs(center) + half).max())
        if not far <= LARGEST_MEASURED:
            raise InputError(f"transform: it moves a corner beyond {LARGEST_MEASURED:g}; move by less")
        return move(corners, matrix), max(float(half.max()), math.ulp(0.0))
