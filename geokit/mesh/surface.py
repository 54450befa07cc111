"""A triangle mesh prepared for queries: frame, bounding volume hierarchy and sign."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit import _arrays, _launch
from geokit._frame import Frame
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh.model import TriangleMesh

if TYPE_CHECKING:
    import warp as wp

    from geokit.mesh.audit import MeshAudit

__all__ = ["ClosestPoints", "RayHits", "SignedDistances", "Surface"]

# Triangles in a leaf: on a CPU a leaf of eight is one contiguous read, on a GPU one triangle a thread diverges least.
LEAF_SIZE_CPU = 8
LEAF_SIZE_CUDA = 1

# The order of queries is resolved over twice the mesh's box: what is farther away is clamped to its sides.
ORDER_HALF_WIDTH = 2.0

# Directions shorter than this would lose digits as denormal numbers inside the edge functions.
SHORTEST_DIRECTION = 1e-150


class ClosestPoints(NamedTuple):
    """points (N, 3) [world], distance (N,) [world], triangle_id (N,), barycentric (N, 3).

    A miss has triangle_id -1, distance inf, and NaN elsewhere.
    """

    points: Any
    distance: Any
    triangle_id: Any
    barycentric: Any


class SignedDistances(NamedTuple):
    """distance (N,) [world], negative inside; points (N, 3) [world], triangle_id (N,), barycentric (N, 3)."""

    distance: Any
    points: Any
    triangle_id: Any
    barycentric: Any


class RayHits(NamedTuple):
    """t (N,) in units of the ray's direction, triangle_id (N,), barycentric (N, 3).

    A miss has triangle_id -1, t inf, and NaN elsewhere.
    """

    t: Any
    triangle_id: Any
    barycentric: Any


class Surface:
    """A mesh prepared once for many queries on one device.

    Args:
        mesh: The triangles; at least one.
        device: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
    Attributes:
        mesh: The triangles.
        bounds: Box around them [world], shape (2, 3).
    Raises:
        InputError: The mesh has no faces, or there is no such device.
        DeviceMemoryError: The device cannot hold the mesh.
    """

    def __init__(self, mesh: TriangleMesh, *, device: Any = None) -> None:
        if not isinstance(mesh, TriangleMesh):
            raise InputError(f"mesh: {type(mesh).__name__} is not a TriangleMesh; make one from vertices and faces")
        if len(mesh.faces) == 0:
            raise InputError(f"mesh: {mesh.name or 'it'} has no faces; queries need at least one triangle")
        self.mesh = mesh
        self._device = _launch.resolve_device(device)
        import warp as wp

        self.bounds = mesh.bounds
        self._frame = Frame.around(*self.bounds)
        try:
            self._prepare(wp)
        except RuntimeError as error:
            if "allocat" not in str(error).lower():
                raise
            size = 350 * len(mesh.faces) + 36 * len(mesh.vertices)
            raise DeviceMemoryError(
                f"mesh: {len(mesh.faces)} faces need about {size >> 20} MiB on {self.device}; "
                "free some there or use another device"
            ) from error
        # Arguments of every kernel that walks the tree.
        self._tree = [
            wp.uint64(self._warp_mesh.id),
            self._corners,
            wp.vec3d(*map(float, self._frame.origin)),
            wp.float64(self._frame.scale),
        ]

    def _prepare(self, wp: Any) -> None:
        from geokit.mesh._bvh_kernels import gather_corners_kernel

        device, mesh = self._device, self.mesh
        # Vertices that no face uses may lie anywhere; in the frame of the faces they could overflow float32.
        local = self._frame.to_local(np.clip(mesh.vertices, *self.bounds))
        faces = wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device)
        self._warp_mesh = wp.Mesh(
            points=wp.array(local, dtype=wp.vec3, device=device),
            indices=faces,
            support_winding_number=True,
            bvh_leaf_size=LEAF_SIZE_CPU if device.is_cpu else LEAF_SIZE_CUDA,
        )
        vertices = wp.array(mesh.vertices, dtype=wp.vec3d, device=device)
        self._corners = wp.empty(3 * len(mesh.faces), dtype=wp.vec3d, device=device)
        identifier = wp.uint64(self._warp_mesh.id)
        _launch.launch(gather_corners_kernel, len(mesh.faces), [identifier, vertices, faces], [self._corners], device)

    @property
    def device(self) -> str:
        """Alias of the device that answers: "cpu", "cuda:0", ..."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Handle for the user's own kernels: pass it as ``wp.uint64`` to warp's ``mesh_query_*`` built-ins.

        The mesh behind it is in local coordinates: ``(world - origin) / scale``.
        """
        return int(self._warp_mesh.id)

    @property
    def origin(self) -> np.ndarray:
        """Origin of the local frame [world], shape (3,)."""
        return self._frame.origin.copy()

    @property
    def scale(self) -> float:
        """Length of one local unit [world]."""
        return self._frame.scale

    @property
    def sign_method(self) -> str:
        """How inside is told from outside: "winding" is the generalised winding number against 1/2."""
        return "winding"

    @cached_property
    def audit(self) -> MeshAudit:
        """What :func:`geokit.mesh.audit` says of the mesh; computed when first asked for."""
        from geokit.mesh.audit import audit

        return audit(self.mesh)

    @property
    def is_closed(self) -> bool:
        """True where every edge joins two triangles that wind alike: winding numbers are whole, zero far away."""
        return self.audit.watertight and self.audit.oriented

    @property
    def orientation(self) -> int:
        """-1 for a closed mesh that is inside out, whose winding numbers are negated here; else 1."""
        return -1 if self.audit.inside_out else 1

    def closest_point(self, points: Any, *, max_distance: float = math.inf) -> ClosestPoints:
        """Closest point on the surface for each query point.

        Exact for float64 coordinates, to 1e-12 of the mesh's diagonal (tests/property/test_closest_point.py); ties go
        to the lowest triangle_id. Triangles without area answer as the segment or point that they are.

        Args:
            points: Query points [world], shape (N, 3).
            max_distance: Search radius [world]; farther points are misses.
        Returns:
            ClosestPoints with points (N, 3) [world], distance (N,) [world], triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: points is not (N, 3) or not finite, or max_distance is negative or not a number.
        Source:
            Ericson, Real-Time Collision Detection (2005), 5.1.5. Differs: float64, slivers from their edges.
        Example:
            >>> surface = Surface(TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), device="cpu")
            >>> surface.closest_point([[0.25, 0.25, 2.0]]).distance
            array([2.])
        """
        batch = _arrays.read_vectors(points, "points", self._device)
        found = self._closest(batch.array, _radius(max_distance))
        return ClosestPoints(*(batch.give(array) for array in found))

    def signed_distance(self, points: Any) -> SignedDistances:
        """Distance to the surface for each query point, negative inside.

        The magnitude is that of :meth:`closest_point`. The sign is that of the winding number against 1/2, summed in
        float32: on clean closed meshes it is right for points farther than 1e-6 diagonals from the surface
        (tests/stability/test_sign.py); on meshes with holes or overlaps it degrades gently.

        Args:
            points: Query points [world], shape (N, 3).
        Returns:
            SignedDistances with distance (N,) [world], points (N, 3) [world], triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: points is not (N, 3) or not finite.
        Source:
            Jacobson, Kavan, Sorkine-Hornung, "Robust Inside-Outside Segmentation using Generalized Winding Numbers"
            (2013); Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018), as warp implements it.
        """
        from geokit.mesh._winding_kernels import sign_kernel

        batch = _arrays.read_vectors(points, "points", self._device)
        closest = self._closest(batch.array, math.inf)
        self._query(sign_kernel, batch.array, self._winding_arguments(), [closest.distance])
        return SignedDistances(
            *(batch.give(a) for a in (closest.distance, closest.points, closest.triangle_id, closest.barycentric))
        )

    def contains(self, points: Any) -> Any:
        """True for points inside, where the winding number exceeds 1/2.

        Args:
            points: Query points [world], shape (N, 3).
        Returns:
            bool (N,).
        Raises:
            InputError: points is not (N, 3) or not finite.
        """
        import warp as wp

        from geokit.mesh._winding_kernels import contains_kernel

        batch = _arrays.read_vectors(points, "points", self._device)
        inside = wp.empty(len(batch), dtype=wp.bool, device=self._device)
        self._query(contains_kernel, batch.array, self._winding_arguments(), [inside])
        return batch.give(inside)

    def winding_number(self, points: Any) -> Any:
        """Generalised winding number: 1 inside a closed mesh, 0 outside, in between around holes.

        Summed in float32 with distant triangles as dipoles: within 0.02 of the exact sum
        (tests/stability/test_sign.py). Negated where ``orientation`` is -1.

        Args:
            points: Query points [world], shape (N, 3).
        Returns:
            float (N,).
        Raises:
            InputError: points is not (N, 3) or not finite.
        Source:
            Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018), as warp implements it, accuracy 2.
        """
        import warp as wp

        from geokit.mesh._winding_kernels import winding_number_kernel

        batch = _arrays.read_vectors(points, "points", self._device)
        winding = wp.empty(len(batch), dtype=wp.float64, device=self._device)
        self._query(winding_number_kernel, batch.array, self._winding_arguments(), [winding])
        return batch.give(winding)

    def raycast(self, origins: Any, directions: Any, *, max_distance: float = math.inf) -> RayHits:
        """First hit of each ray, through no shared edge or vertex (tests/stability/test_ray_leaks.py).

        Args:
            origins: Where rays start [world], shape (N, 3).
            directions: Their directions, of any length, shape (N, 3).
            max_distance: Length of the rays [world]; farther hits are misses.
        Returns:
            RayHits with t (N,) in units of the direction, triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: An array is not (N, 3) or not finite, their lengths differ, a direction is zero, or
                max_distance is negative or not a number.
        Source:
            Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection" (JCGT 2013). Differs: float64 throughout.
        """
        import warp as wp

        from geokit.mesh._raycast_kernels import raycast_kernel

        rays, directions = self._rays(origins, directions)
        t = wp.empty(len(rays), dtype=wp.float64, device=self._device)
        triangle_id = wp.empty(len(rays), dtype=wp.int32, device=self._device)
        barycentric = wp.empty(len(rays), dtype=wp.vec3d, device=self._device)
        self._cast(raycast_kernel, rays, directions, max_distance, [t, triangle_id, barycentric])
        return RayHits(rays.give(t), rays.give(triangle_id), rays.give(barycentric))

    def occluded(self, origins: Any, directions: Any, *, max_distance: float = math.inf) -> Any:
        """True for rays that hit anything; quicker than :meth:`raycast`, which looks for the first hit.

        Args:
            origins: Where rays start [world], shape (N, 3).
            directions: Their directions, of any length, shape (N, 3).
            max_distance: Length of the rays [world].
        Returns:
            bool (N,).
        Raises:
            InputError: As for :meth:`raycast`.
        """
        import warp as wp

        from geokit.mesh._raycast_kernels import occluded_kernel

        rays, directions = self._rays(origins, directions)
        occluded = wp.empty(len(rays), dtype=wp.bool, device=self._device)
        self._cast(occluded_kernel, rays, directions, max_distance, [occluded])
        return rays.give(occluded)

    def _closest(self, points: "wp.array", max_distance: float) -> ClosestPoints:
        import warp as wp

        from geokit.mesh._closest_point_kernels import closest_point_kernel

        count, device = len(points), self._device
        found = ClosestPoints(
            points=wp.empty(count, dtype=wp.vec3d, device=device),
            distance=wp.empty(count, dtype=wp.float64, device=device),
            triangle_id=wp.empty(count, dtype=wp.int32, device=device),
            barycentric=wp.empty(count, dtype=wp.vec3d, device=device),
        )
        self._query(closest_point_kernel, points, [*self._tree, wp.float64(max_distance)], list(found))
        return found

    def _query(self, kernel: Any, points: "wp.array", inputs: list[Any], outputs: list["wp.array"]) -> None:
        half = ORDER_HALF_WIDTH * self._frame.scale
        lower = self._frame.origin - half
        _launch.launch_queries(kernel, points, inputs, outputs, self._device, lower=lower, extent=2.0 * half)

    def _winding_arguments(self) -> list[Any]:
        import warp as wp

        identifier, _, origin, scale = self._tree
        # A closed mesh winds around nothing outside its box.
        empty = 1.0 if self.is_closed else math.inf
        return [identifier, origin, scale, wp.float64(empty), float(self.orientation)]

    def _rays(self, origins: Any, directions: Any) -> tuple[_arrays.Batch, _arrays.Batch]:
        rays = _arrays.read_vectors(origins, "origins", self._device)
        heading = _arrays.read_vectors(directions, "directions", self._device)
        if len(rays) != len(heading):
            raise InputError(f"directions: {len(heading)} rows for {len(rays)} origins; give one direction for each")
        _arrays.require_length(heading, "directions", SHORTEST_DIRECTION)
        return rays, heading

    def _cast(
        self, kernel: Any, rays: _arrays.Batch, heading: _arrays.Batch, max_distance: float, outputs: list[Any]
    ) -> None:
        import warp as wp

        from geokit.mesh._raycast_kernels import entry_kernel

        reach = wp.float64(_radius(max_distance))
        _, _, origin, scale = self._tree
        entries = wp.empty(len(rays), dtype=wp.vec3d, device=self._device)
        _launch.launch(entry_kernel, len(rays), [rays.array, heading.array, origin, scale], [entries], self._device)
        _launch.launch_queries(
            kernel,
            entries,
            [*self._tree, reach],
            outputs,
            self._device,
            lower=(-ORDER_HALF_WIDTH,) * 3,
            extent=2.0 * ORDER_HALF_WIDTH,
            streams=[rays.array, heading.array],
        )

    def __repr__(self) -> str:
        return f"Surface({self.mesh!r}, device={self.device!r}, sign_method={self.sign_method!r})"


def _radius(max_distance: float) -> float:
    reach = _arrays.require_finite_scalar(max_distance, "max_distance", low=-math.ulp(0.0), infinite=True)
    return reach
