"""Where points lie against a prepared surface: closest and furthest points, distance with a sign, winding numbers."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit import _arrays, _launch
from geokit._blocks import Progress, in_blocks
from geokit._flags import Flags
from geokit._host_array import HostArray
from geokit.errors import InputError
from geokit.mesh._measurable import require_measurable

if TYPE_CHECKING:
    import warp as wp

    from geokit._frame import Frame
    from geokit.mesh.model import TriangleMesh

__all__ = ["ClosestPoints", "FurthestPoints", "PointQueries", "SignedDistances"]

# The order of queries is resolved over twice the mesh's box: what is farther away is clamped to its sides.
ORDER_HALF_WIDTH = 2.0
# Queries of a thread, each starting from its neighbour's answer: more gain nothing on a CPU. On a GPU a thread for each
# is quickest: what two in a row gain is lost to caches that more distant threads share.
QUERY_GROUP = 32
SIGN_METHODS = ("auto", "winding", "pseudonormal", "parity")


class ClosestPoints(NamedTuple):
    """points (N, 3) [world], distance (N,) [world], triangle_id (N,), barycentric (N, 3).

    A miss has triangle_id -1, distance inf, and NaN elsewhere.
    """

    points: Any
    distance: Any
    triangle_id: Any
    barycentric: Any


class FurthestPoints(NamedTuple):
    """points (N, 3) [world], distance (N,) [world], triangle_id (N,); the points are vertices of those triangles."""

    points: Any
    distance: Any
    triangle_id: Any


class SignedDistances(NamedTuple):
    """distance (N,) [world], negative inside; points (N, 3) [world], triangle_id (N,), barycentric (N, 3)."""

    distance: Any
    points: Any
    triangle_id: Any
    barycentric: Any


class PointQueries:
    """Point queries of a :class:`geokit.mesh.Surface`."""

    mesh: TriangleMesh
    audit: Any
    _device: "wp.Device"
    _frame: Frame
    _tree: Any
    _vertices: "wp.array"
    _faces: "wp.array"

    def closest_point(
        self, points: Any, *, max_distance: float = math.inf, progress: Progress | None = None
    ) -> ClosestPoints:
        """Closest point on the surface for each query point.

        Exact for float64 coordinates, to 1e-12 of the mesh's diagonal (tests/property/test_closest_point.py); ties go
        to the lowest triangle_id. Triangles without area answer as the segment or point that they are.

        Within 1e-6 of the mesh's size up to 1e8 sizes from the origin, and 1e-12 on slivers of any aspect ratio; for
        sizes from 1e-70 to 1e70. Held by tests/stability/test_envelopes.py.

        Args:
            points: Query points [world], shape (N, 3).
            max_distance: Search radius [world]; farther points are misses.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            ClosestPoints with points (N, 3) [world], distance (N,) [world], triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: points is not (N, 3) or not finite, max_distance is negative or not a number, or the mesh is
                smaller than 1e-70 or larger than 1e70.
        Source:
            Ericson, Real-Time Collision Detection (2005), 5.1.5. Differs: float64, slivers from their edges.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.closest_point([[0.25, 0.25, 2.0]]).distance
            array([2.])
        """

        reach = _radius(max_distance)
        require_measurable(self.mesh, self._frame)

        def query(batch: _arrays.Batch) -> ClosestPoints:
            # The search itself sees what is not finite: a pass over the points, on a GPU a wait for it, is saved.
            bad = Flags(1, self._device)
            found = self._closest(batch.rows, reach, bad)
            if bad.numpy()[0]:
                _arrays.require_finite(batch, "points")
            return ClosestPoints(*(batch.give(array) for array in found))

        return in_blocks(query, [points], ["points"], self._device, progress, defer=True)

    def furthest_point(self, points: Any) -> FurthestPoints:
        """Furthest point of the surface for each query point: always a vertex, exact in float64.

        Ties go to the lowest triangle_id, and within it to the first corner (tests/unit/test_surface.py).

        Args:
            points: Query points [world], shape (N, 3).
        Returns:
            FurthestPoints with points (N, 3) [world], distance (N,) [world], triangle_id (N,).
        Raises:
            InputError: points is not (N, 3) or not finite.
        """
        import warp as wp

        from geokit.mesh._furthest_kernels import furthest_point_kernel

        batch = _arrays.read_vectors(points, "points", self._device)
        found = FurthestPoints(
            points=_arrays.empty(len(batch), wp.vec3d, batch.rows),
            distance=_arrays.empty(len(batch), wp.float64, batch.rows),
            triangle_id=_arrays.empty(len(batch), wp.int32, batch.rows),
        )
        self._query(furthest_point_kernel, batch.rows, [self._tree], list(found))
        return FurthestPoints(*(batch.give(array) for array in found))

    def signed_distance(
        self, points: Any, *, sign: str = "auto", max_distance: float = math.inf, progress: Progress | None = None
    ) -> SignedDistances:
        """Distance to the surface for each query point, negative inside.

        The magnitude is that of :meth:`closest_point`. The sign comes from ``sign``, for the mesh as
        :func:`geokit.mesh.orient` would wind it (``orientation``):

        - "auto": what ``sign_method`` says: "pseudonormal" where the mesh is proven clean, else "winding";
          ``sign_reason`` says why.
        - "pseudonormal": from the angle-weighted normal at the closest face, edge or vertex, in float64. Exact on
          clean meshes; that a mesh is clean is then the caller's promise.
        - "winding": the generalised winding number against 1/2. On clean meshes right for points farther than 1e-6
          diagonals from the surface; on meshes with holes, flips, duplicates or overlaps it degrades gently
          (tests/stability/test_sign.py). :meth:`sign_confidence` says how firmly it decides.
        - "parity": odd or even crossings along three rays, by majority. For closed meshes; nested and overlapping
          parts count as holes.

        Within 1e-6 of the mesh's size, and signs right for points 1e-5 sizes from the surface, up to 1e9 sizes from the
        origin. Queries may be 1e150 away (4e-15 of the distance). Walls of 1e-14 of the size keep their sides apart, on
        a GPU 1e-11. On a sphere, of points in 1.5 times its box: with a hole of 10% of its area the winding number has
        under 3% of the signs wrong, pseudonormals 2%, parity 7%; with small holes of 20% the winding number under 0.5%,
        with a soup of which 10% are flipped under 1.5%; copies and overlaps cost it none. Held by
        tests/stability/test_envelopes.py.

        Args:
            points: Query points [world], shape (N, 3).
            sign: How inside is told from outside.
            max_distance: Search radius [world]; farther points have distance inf or -inf, triangle_id -1 and NaN
                elsewhere. Their signs are by winding number where ``sign`` is "pseudonormal".
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            SignedDistances with distance (N,) [world], points (N, 3) [world], triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: points is not (N, 3) or not finite, max_distance is negative or not a number, or there is no
                such sign.
        Source:
            Bærentzen, Aanæs, "Signed Distance Computation Using the Angle Weighted Pseudonormal" (2005); Jacobson,
            Kavan, Sorkine-Hornung, "Robust Inside-Outside Segmentation using Generalized Winding Numbers" (2013);
            Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018).
        """
        method, reach = self._method(sign), _radius(max_distance)
        require_measurable(self.mesh, self._frame)

        def query(batch: _arrays.Batch) -> SignedDistances:
            closest = self._closest(batch.rows, reach)
            self._sign(method, batch.rows, closest, reach)
            found = closest.distance, closest.points, closest.triangle_id, closest.barycentric
            return SignedDistances(*(batch.give(array) for array in found))

        return in_blocks(query, [points], ["points"], self._device, progress)

    def contains(self, points: Any, *, sign: str = "auto", progress: Progress | None = None) -> Any:
        """True for points inside, by the sign that :meth:`signed_distance` would give.

        Args:
            points: Query points [world], shape (N, 3).
            sign: As for :meth:`signed_distance`.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            bool (N,). Points on the surface are outside.
        Raises:
            InputError: points is not (N, 3) or not finite, or there is no such sign.
        """
        import warp as wp

        from geokit.mesh._sign_kernels import is_negative_kernel

        method, device = self._method(sign), self._device
        require_measurable(self.mesh, self._frame)

        def query(batch: _arrays.Batch) -> Any:
            count = len(batch)
            if method == "pseudonormal":
                found = self._closest(batch.rows, math.inf)
            else:
                found = ClosestPoints(None, wp.full(count, wp.float64(1.0), device=device), None, None)
            self._sign(method, batch.rows, found, math.inf)
            if isinstance(found.distance, HostArray):  # a launch takes longer than this does for thousands of points
                return batch.give(HostArray(found.distance.values < 0.0))
            inside = _arrays.empty(count, wp.bool, batch.rows)
            _launch.launch(is_negative_kernel, count, [found.distance], [inside], device)
            return batch.give(inside)

        return in_blocks(query, [points], ["points"], device, progress)

    def winding_number(self, points: Any, *, progress: Progress | None = None) -> Any:
        """Generalised winding number: 1 inside a closed mesh, 0 outside, in between around holes.

        Within 0.005 of the exact sum on a CPU, k times that where k surfaces coincide, and 0.02 on CUDA
        (tests/stability/test_sign.py, tests/unit/test_winding.py). Faces count as ``orientation`` says.

        Args:
            points: Query points [world], shape (N, 3).
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            float (N,).
        Raises:
            InputError: points is not (N, 3) or not finite.
        Source:
            Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018). Differs: on a CPU harmonic moments of
            three orders and exact solid angles nearby, in float64 next to triangles.
        """

        def query(batch: _arrays.Batch) -> Any:
            return batch.give(self._winding(batch.rows))

        return in_blocks(query, [points], ["points"], self._device, progress)

    def sign_confidence(self, points: Any) -> Any:
        """How firmly the winding number tells inside from outside: its distance from 1/2.

        1/2 or more where there is no doubt, near 0 in the holes of an open mesh, where either answer may be right.

        Args:
            points: Query points [world], shape (N, 3).
        Returns:
            float (N,).
        Raises:
            InputError: points is not (N, 3) or not finite.
        """
        import warp as wp

        from geokit.mesh._sign_kernels import confidence_kernel

        batch = _arrays.read_vectors(points, "points", self._device)
        confidence = _arrays.empty(len(batch), wp.float64, batch.rows)
        winding = self._winding(batch.rows)
        _launch.launch(confidence_kernel, len(batch), [winding], [confidence], self._device)
        return batch.give(confidence)

    @property
    def sign_method(self) -> str:
        """What ``sign="auto"`` is for this mesh: "pseudonormal" where it is proven clean, else "winding".

        Proven is that every edge joins two faces that wind alike (turned where ``orientation`` says so), that the
        faces around each vertex are one fan, that none is without area, twice there, or cuts another, and that parts
        within each other are cavities. Decided when first asked for (tests/unit/test_sign_choice.py).
        """
        return self._sign_choice.method

    @property
    def sign_reason(self) -> str:
        """Why ``sign_method`` is what it is: what was proven, or the first defect that was found."""
        return self._sign_choice.reason

    @cached_property
    def _sign_choice(self) -> Any:
        from geokit.mesh._sign_choice import choose_sign

        return choose_sign(self)  # type: ignore[arg-type]

    @property
    def is_closed(self) -> bool:
        """True where every edge joins two triangles that wind alike: winding numbers are whole, zero far away."""
        return self._orientation.closed

    @property
    def orientation(self) -> int:
        """1 where all faces count as they wind, -1 where all count as turned (the mesh is inside out), 0 where some do.

        Signs and winding numbers are those of the mesh that :func:`geokit.mesh.orient` gives; rays do not care.
        """
        flipped: NDArray[np.bool_] = self._orientation.flipped
        if not flipped.any():
            return 1
        return -1 if flipped.all() else 0

    @cached_property
    def _orientation(self) -> Any:
        from geokit.mesh._orientation import orient_faces

        return orient_faces(self.mesh, self, self._topology)  # type: ignore[arg-type]

    @cached_property
    def _topology(self) -> Any:
        from geokit.mesh._topology import mesh_topology

        return mesh_topology(self.mesh)

    @cached_property
    def _pseudonormals(self) -> list["wp.array"]:
        from geokit.mesh._pseudonormals import pseudonormal_tables

        flipped = self._orientation.flipped
        tables = pseudonormal_tables(self.mesh, self._topology, flipped, self._vertices, self._faces)
        # It takes more room than the mesh, and nothing else asks for it.
        self.__dict__.pop("_topology", None)
        return tables

    def _method(self, sign: str) -> str:
        if sign not in SIGN_METHODS:
            raise InputError(f"sign: {sign!r} is not a method; use one of {', '.join(map(repr, SIGN_METHODS))}")
        return self.sign_method if sign == "auto" else sign

    def _sign(self, method: str, points: "wp.array", closest: ClosestPoints, reach: float) -> None:
        """Turns the distances of inside points negative, in place; ``reach`` is how far was searched."""
        from geokit.mesh import _sign
        from geokit.mesh._pseudonormals import by_pseudonormal

        if method == "pseudonormal":
            tables, device = self._pseudonormals, self._device
            found = [points, closest.points, closest.triangle_id, closest.barycentric]
            by_pseudonormal(found, tables, closest.distance, device)
            # Without a limit only what is 1e150 away can be missed, and that is outside.
            if reach < math.inf and _sign.any_missed(closest.triangle_id):
                _sign.missed_by_winding(self._winding(points), closest, device)
        elif method == "winding":
            from geokit.mesh._wide_winding_kernels import sign_kernel

            self._query(sign_kernel, points, self._winding_arguments(), [closest.distance])
        else:
            _sign.by_parity(self, points, closest.distance)

    def _closest(self, points: Any, max_distance: float, bad: Any = None) -> ClosestPoints:
        """``bad``, (1,) of int32, is set to 1 where a point is not finite."""
        import warp as wp

        from geokit.mesh._closest_point_kernels import closest_point_kernel

        count, device = len(points), self._device
        found = ClosestPoints(
            points=_arrays.empty(count, wp.vec3d, points),
            distance=_arrays.empty(count, wp.float64, points),
            triangle_id=_arrays.empty(count, wp.int32, points),
            barycentric=_arrays.empty(count, wp.vec3d, points),
        )
        group = QUERY_GROUP if device.is_cpu else 1
        bad = Flags(1, device) if bad is None else bad
        self._query(closest_point_kernel, points, [self._tree, wp.float64(max_distance)], list(found), group, bad)
        return found

    def _order_box(self) -> tuple[NDArray[np.float64], float]:
        """Lower corner and edge length [world] of the box that the order of queries resolves."""
        half = ORDER_HALF_WIDTH * self._frame.scale
        return self._frame.origin - half, 2.0 * half

    def _query(
        self,
        kernel: Any,
        points: Any,
        inputs: list[Any],
        outputs: list[Any],
        group: int = 0,
        flag: Any = None,
    ) -> None:
        """``flag`` is a further output that all queries share."""
        lower, extent = self._order_box()
        flags = [] if flag is None else [flag]
        _launch.launch_queries(
            kernel, points, inputs, outputs, self._device, lower=lower, extent=extent, group=group, flags=flags
        )

    def _winding(self, points: "wp.array") -> "wp.array":
        import warp as wp

        from geokit.mesh._wide_winding_kernels import winding_number_kernel

        winding = _arrays.empty(len(points), wp.float64, points)
        self._query(winding_number_kernel, points, self._winding_arguments(), [winding])
        return winding

    @cached_property
    def _winding_tree(self) -> Any:
        from geokit.mesh._wide_winding import build_winding_tree, winding_tree_of_mesh

        flipped: NDArray[np.bool_] = self._orientation.flipped
        if self._device.is_cpu:
            return build_winding_tree(self._tree, flipped)
        # The handle keeps no mesh alive: the surface must.
        self._turned_mesh = self._warp_mesh  # type: ignore[attr-defined]
        if flipped.any():
            faces = np.where(flipped[:, None], self.mesh.faces[:, ::-1], self.mesh.faces)
            self._turned_mesh = self._make_warp_mesh(faces)  # type: ignore[attr-defined]
        return winding_tree_of_mesh(self._turned_mesh)

    def _winding_arguments(self) -> list[Any]:
        import warp as wp

        # A closed mesh winds around nothing outside its box.
        empty = 1.0 if self.is_closed else math.inf
        return [self._tree, self._winding_tree, wp.float64(empty)]


def _radius(max_distance: float) -> float:
    return _arrays.require_finite_scalar(max_distance, "max_distance", low=-math.ulp(0.0), infinite=True)
