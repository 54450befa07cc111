"""Closest and furthest points of a prepared surface; sign/queries.py tells inside from outside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.blocks.chunked_queries import Progress, in_chunks
from geokit.core.blocks.several_devices import LEAST_ON_GPUS
from geokit.core.gradients.rules import untracked
from geokit.core.interop import user_arrays
from geokit.core.interop.arrays import import_array
from geokit.core.interop.types import Array, Rows
from geokit.core.launches.late_checks import later
from geokit.core.memory.needs import rows
from geokit.core.memory.pinned import host_flags
from geokit.core.query.ask import query
from geokit.core.require import require_unrecorded
from geokit.mesh.attributes.interpolation import chosen_names, interpolated, interpolation_bytes
from geokit.mesh.topology.size_limits import require_measurable

if TYPE_CHECKING:
    import warp as wp

    from geokit.core.frame import Frame
    from geokit.core.memory.host_array import HostArray
    from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["ClosestPoints", "FurthestPoints", "PointQueries", "checked_radius", "refuse_raised"]

# The Morton order of queries covers twice the mesh's box; points farther away are clamped to its sides.
ORDER_HALF_WIDTH = 2.0
# Queries per thread on a CPU, each starting from the previous answer; more gain nothing. On a GPU one thread per query
# is fastest: two in a row gain less than they lose to caches that more distant threads share.
QUERY_GROUP = 32


class ClosestPoints(NamedTuple):
    """The closest point of a surface for each query point.

    A miss has triangle_id -1, distance inf, and NaN elsewhere. Read fields by name: SignedDistances has another order.

    Attributes:
        points: The closest points [world], shape (N, 3).
        distance: Distances to them [world], shape (N,).
        triangle_id: Triangles that they lie on, shape (N,) int32.
        barycentric: Weights of the triangles' corners there, shape (N, 3).
    """

    points: Array
    distance: Array
    triangle_id: Array
    barycentric: Array


class FurthestPoints(NamedTuple):
    """The furthest point of a surface for each query point: a vertex.

    Attributes:
        points: The furthest points [world], shape (N, 3).
        distance: Distances to them [world], shape (N,).
        triangle_id: Triangles that have them as vertices, shape (N,) int32.
    """

    points: Array
    distance: Array
    triangle_id: Array


class PointQueries:
    """Point queries of a :class:`geokit.mesh.Surface`."""

    mesh: TriangleMesh
    _device: "wp.Device"
    _frame: Frame
    _tree: Any

    @query("points", gradient=".gradients:CLOSEST_POINT", is_replayed=True, least_rows=LEAST_ON_GPUS, row_bytes=80)
    def closest_point(
        self,
        points: Rows,
        *,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> ClosestPoints:
        """Closest point on the surface for each query point.

        Exact for float64 coordinates, to 1e-12 of the mesh's diagonal; ties go to the lowest triangle_id. Triangles
        without area are treated as segments or points.

        Distances are within 1e-6 of the mesh's size up to 1e8 sizes from the origin, and within 1e-12 on slivers of any
        aspect ratio, for mesh sizes from 1e-70 to 1e70.

        Args:
            points: Query points [world], shape (N, 3).
            max_distance: Search radius [world]; farther points are misses.
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            ClosestPoints with points (N, 3) [world], distance (N,) [world], triangle_id (N,), barycentric (N, 3). A
            miss has triangle_id -1, distance inf, and NaN elsewhere.
        Raises:
            InputError: points is not (N, 3) or not finite, max_distance is negative or not a number, the transform is
                not rigid (to 1e-6) or is given beside tensors with gradients, or the mesh is smaller than 1e-70 or
                larger than 1e70.
        Source:
            Ericson, Real-Time Collision Detection (2005), 5.1.5. Differs: float64, slivers from their edges.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.closest_point([[0.25, 0.25, 2.0]]).distance
            array([2.])
        """

        reach = checked_radius(max_distance)
        require_measurable(self.mesh, self._frame)

        def query(batch: user_arrays.Batch) -> ClosestPoints:
            # The kernel itself checks for non-finite points: this saves a pass over them and, on a GPU, a wait for it.
            bad = host_flags(1, self._device)
            found = self._closest(batch.rows, reach, bad)
            # A GPU is at work meanwhile: the flag waits for it.
            answer = ClosestPoints(*(batch.to_caller(array) for array in found))
            later(lambda: refuse_raised(bad, batch), self._device)
            return answer

        return in_chunks(query, [points], ["points"], self._device, progress, defer=True)

    # Its answers are dictionaries of NumPy arrays, so calls are not replayed.
    @query(
        "points", memory=lambda self, points, *, names=None, **_: interpolation_bytes(self.mesh, names) * rows(points)
    )
    def sample_attributes(
        self, points: Rows, *, max_distance: float = math.inf, names: Sequence[str] | None = None
    ) -> dict[str, np.ndarray]:
        """Attributes of the mesh at the closest point of each query point.

        Floats and colors on vertices and corners are interpolated by barycentric weights, in float64, and rounded once
        to their type; ``normal`` gets unit length again. Other integers and bools are those of the corner with the
        largest weight. Of one name on several elements, corners win over vertices over faces.

        Values are within 1e-12 of the range of the values at the triangle's corners, plus the rounding to their type.
        Points know no sides: beside a thin wall the closest point may be on the other one. Those of a mesh do:
        :func:`geokit.mesh.transfer_attributes`.

        Args:
            points: Query points [world], shape (N, 3).
            max_distance: Search radius [world]; farther points are misses.
            names: The attributes; None for all.
        Returns:
            NumPy arrays by name, (N,) or (N, k), without the first axis for one point (3,). Misses are NaN, 0 in
            integers, and -1 in ``material``.
        Raises:
            InputError: As for :meth:`closest_point`, or the mesh has no attribute of a name.
        Example:
            >>> heat = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]],
            ...     vertex_data={"heat": [0.0, 8.0, 4.0]})
            >>> gk.mesh.Surface(heat, device="cpu").sample_attributes([[0.25, 0.25, 2.0]])["heat"]
            array([3.])
        """
        asked = chosen_names(self.mesh, names)
        require_unrecorded(points, "points")
        if isinstance(points, np.ndarray) and points.dtype == np.float32:
            points = points.astype(np.float64)  # answers would be float32, weights too
        found = untracked(self).closest_point(points, max_distance=max_distance)
        triangle_id, barycentric = _on_host(found.triangle_id), _on_host(found.barycentric)
        table = barycentric.reshape(-1, 3).astype(np.float64)
        values = interpolated(self.mesh, triangle_id.reshape(-1), table, asked)
        return values if barycentric.ndim == 2 else {name: rows[0] for name, rows in values.items()}

    @query("points", is_replayed=True, least_rows=LEAST_ON_GPUS, row_bytes=72)
    def furthest_point(self, points: Rows, *, transform: ArrayLike | None = None) -> FurthestPoints:
        """Furthest point of the surface for each query point: always a vertex, exact in float64.

        Ties go to the lowest triangle_id, and within it to the first corner.

        Args:
            points: Query points [world], shape (N, 3).
            transform: As for :meth:`closest_point`.
        Returns:
            FurthestPoints with points (N, 3) [world], distance (N,) [world], triangle_id (N,).
        Raises:
            InputError: points is not (N, 3) or not finite, or the transform is not rigid (to 1e-6).
        """
        import warp as wp

        from geokit.mesh.queries.furthest_kernels import furthest_point_kernel

        largest = user_arrays.LARGEST_MEASURED
        batch = user_arrays.read_vectors(points, "points", self._device, pin=True, single=True, largest=largest)
        found = [user_arrays.empty(len(batch), kind, batch.rows) for kind in (wp.vec3d, wp.float64, wp.int32)]
        self._query(furthest_point_kernel, batch.rows, [self._tree], found)
        return FurthestPoints(*(batch.to_caller(array) for array in found))

    def _closest(self, points: Any, max_distance: float, bad: HostArray) -> ClosestPoints:
        """Closest points; ``bad`` is raised if a point is not finite, and such a point is a miss."""
        import warp as wp

        from geokit.mesh.queries.closest_point_kernels import closest_point_kernel

        count, device = len(points), self._device
        found = ClosestPoints(*user_arrays.empty_outputs(count, [wp.vec3d, wp.float64, wp.int32, wp.vec3d], points))
        group = QUERY_GROUP if device.is_cpu else 1
        self._query(closest_point_kernel, points, [self._tree, wp.float64(max_distance)], list(found), group, bad)
        return found

    def _query(
        self, kernel: Any, points: Rows, inputs: list[Any], outputs: list[Any], group: int = 0, flag: Any = None
    ) -> None:
        """``flag`` is a further output that all queries share."""
        # The box that the order of queries resolves [world].
        half = ORDER_HALF_WIDTH * self._frame.scale
        lower, extent = self._frame.origin - half, 2.0 * half
        flags = [] if flag is None else [flag]
        launcher.launch_queries(
            kernel, points, inputs, outputs, self._device, lower=lower, extent=extent, group=group, flags=flags
        )


def _on_host(values: Any) -> NDArray[Any]:
    if isinstance(values, np.ndarray):
        return values
    if len(values.shape) == 0:  # of one point; warp knows no such arrays
        return np.array(int(values))
    held = values if hasattr(values, "numpy") and hasattr(values, "ptr") else import_array(values, "points")
    return np.asarray(held.numpy())


def checked_radius(max_distance: float) -> float:
    return user_arrays.require_finite_scalar(max_distance, "max_distance", low=user_arrays.FROM_ZERO, infinite=True)


def refuse_raised(bad: HostArray, batch: user_arrays.Batch) -> None:
    """Raise InputError and name the first point that is not finite or too far away, if a kernel has raised ``bad``."""
    if bad.numpy()[0]:
        user_arrays.require_finite(batch, "points", user_arrays.LARGEST_MEASURED)
