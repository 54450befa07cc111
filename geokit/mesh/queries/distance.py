"""Least distance of two surfaces, one of which may have been moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.snapshot import snapshot
from geokit.core.interop.user_arrays import LARGEST_MEASURED
from geokit.core.query.ask import query
from geokit.core.require import require_affine_maps, require_one_world
from geokit.errors import InputError
from geokit.mesh.queries.overlaps import LEAF_GRAIN, OverlapQueries, require_surface
from geokit.mesh.topology.size_limits import require_measurable

# Corners that give the first bound, and slots for each of them. More cost more than their bound saves.
BOUND_CORNERS = 512
BOUND_STRIDE = 16
# Leaves in all poses that are searched at a time.
ROWS = 1 << 22


class SurfaceDistance(NamedTuple):
    """Least distance of two surfaces, and where it is.

    Of several poses each is an array with one more dimension, the first.

    Attributes:
        distance: The least distance [world].
        point: Where it is on the first surface [world], shape (3,).
        other_point: Where it is on the other one [world], shape (3,).
        triangle_id, other_triangle_id: The triangles that these lie on.
    """

    distance: float | NDArray[np.float64]
    point: NDArray[np.float64]
    other_point: NDArray[np.float64]
    triangle_id: int | NDArray[np.int32]
    other_triangle_id: int | NDArray[np.int32]


class DistanceQueries(OverlapQueries):
    """Distances of a :class:`geokit.mesh.Surface` from others."""

    @query(memory=lambda self, *_, **__: 16 * self.mesh.face_count)
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
                0, 0, 0, 1, or many such maps, (B, 4, 4). It may change the unit and the axis that is up. None leaves it
                in place. No new tree is built.
        Returns:
            SurfaceDistance with distance, point (3,), other_point (3,), triangle_id, other_triangle_id. For many maps,
            with the same bits: distance (B,), point (B, 3), other_point (B, 3), triangle_id (B,), other_triangle_id
            (B,).
        Raises:
            InputError: other is not a Surface, or is on another device; units or up axes are known and differ, without
                a transform; that has another shape or last row or a number that is not finite, or moves a corner
                beyond 1e150; a mesh is smaller than 1e-70 or larger than 1e70.
            DeviceMemoryError: The device cannot hold a pair for each triangle.
        Source:
            Ericson, Real-Time Collision Detection (2005), 5.1.10. Differs: contact is decided by the predicates of
            :meth:`intersecting_triangles`, and edges that are nearly parallel keep their digits.
        Example:
            >>> low = gk.mesh.Surface(gk.mesh.sphere(radius=1.0), device="cpu")
            >>> high = gk.mesh.Surface(gk.mesh.box(size=(8, 8, 1), center=(0, 0, 5)), device="cpu")
            >>> round(low.distance(high).distance, 9)
            3.5
            >>> up = np.eye(4) + np.zeros((3, 1, 1))
            >>> up[:, 2, 3] = [0, 1, 2]
            >>> low.distance(high, transform=up).distance.round(9)
            array([3.5, 2.5, 1.5])
        """
        given = np.eye(4) if transform is None else require_affine_maps(transform, "transform")
        found = self._of_blocks(self._distances, other, given.reshape(-1, 4, 4), transform is None)
        if given.ndim == 2:
            distance, point, other_point, triangle_id, other_triangle_id = (each[0] for each in found)
            return SurfaceDistance(float(distance), point, other_point, int(triangle_id), int(other_triangle_id))
        return SurfaceDistance(*found)

    def _of_blocks(
        self, answer: Callable[..., Any], other: OverlapQueries, maps: NDArray[np.float64], in_place: bool
    ) -> list[NDArray[Any]]:
        """The arrays that ``answer(other, maps, unit)`` gives for as many poses at a time as there is room for."""
        other = snapshot(require_surface(self, other))
        if in_place:
            require_one_world(surface=self.mesh, other=other.mesh)
        require_measurable(self.mesh, self._frame)
        require_measurable(other.mesh, other._frame)
        scale = self._moved_scales(maps)
        # A power of two scales without rounding; unscaled, products of corners could underflow.
        unit = np.ldexp(1.0, -np.round(np.log2(np.maximum(scale, other._frame.scale))).astype(np.int32))
        count = max(ROWS // self._leaf_count, 1)
        begins = range(0, max(len(maps), 1), count)
        parts = [answer(other, maps[at : at + count], unit[at : at + count]) for at in begins]
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    def _on_device(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _distances(
        self, other: OverlapQueries, maps: NDArray[np.float64], unit: NDArray[np.float64]
    ) -> tuple[NDArray[Any], ...]:
        """The fields of the answer for some poses."""
        from geokit.mesh.queries import distance_kernels as kernels

        device, slots, leaves, upload = self._device, len(self._tree.slot_triangle), self._leaf_count, self._on_device
        poses = [upload(maps[:, :3, :3], wp.mat33d), upload(maps[:, :3, 3], wp.vec3d)]
        units, stride = upload(unit, wp.float64), max(-(-slots // BOUND_CORNERS), BOUND_STRIDE)
        items = -(-slots // stride)
        bound = upload(np.full(len(maps), np.float64(np.inf).view(np.int64)), wp.int64)
        inputs = [items, self._tree, stride, *poses, other._tree, units]
        launcher.launch(kernels.bound_by_corners_kernel, items * len(maps), inputs, [bound], device, grain=LEAF_GRAIN)
        squared = wp.empty(leaves * len(maps), dtype=wp.float64, device=device)
        pairs = wp.empty(2 * leaves * len(maps), dtype=wp.int32, device=device)
        inputs, outputs = [leaves, self._tree, *poses, other._tree, other._slot_boxes, units], [bound, squared, pairs]
        launcher.launch(kernels.nearest_pair_kernel, leaves * len(maps), inputs, outputs, device, grain=LEAF_GRAIN)
        found = squared.numpy().reshape(-1, leaves)
        least = found.min(axis=1)
        pose, leaf = np.nonzero(found == least[:, None])
        tied = pairs.numpy().reshape(-1, leaves, 2)[pose, leaf]
        triangles = np.stack([each._tree.slot_triangle.numpy()[tied[:, k]] for k, each in enumerate((self, other))])
        order = np.lexsort((triangles[1], triangles[0], pose))
        first = order[np.searchsorted(pose[order], np.arange(len(maps)))]
        points = wp.empty(2 * len(maps), dtype=wp.vec3d, device=device)
        inputs = [self._tree, *poses, other._tree, units, upload(tied[first].ravel(), wp.int32)]
        launcher.launch(kernels.points_of_pair_kernel, len(maps), inputs, [points], device)
        ends = points.numpy().astype(np.float64).reshape(-1, 2, 3)
        return np.sqrt(least) / unit, ends[:, 0], ends[:, 1], *triangles[:, first]

    def _moved_scales(self, maps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Half the longest side of a box around the surface where each map places it."""
        with np.errstate(over="ignore", invalid="ignore"):
            center = maps[:, :3, :3] @ self._frame.origin + maps[:, :3, 3]
            half = np.abs(maps[:, :3, :3]) @ np.full(3, self._frame.scale)
            far = (np.abs(center) + half).max(axis=1)
        beyond = ~(far <= LARGEST_MEASURED)
        if beyond.any():
            which = f"map {int(np.argmax(beyond))} " if len(maps) > 1 else "it "
            raise InputError(f"transform: {which}moves a corner beyond {LARGEST_MEASURED:g}; move by less")
        return np.maximum(half.max(axis=1), math.ulp(0.0))
