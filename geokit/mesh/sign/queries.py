"""Inside or outside of a prepared surface: signed distances, winding numbers, and the sign method."""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit._warn import warn
from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.blocks.chunked_queries import Progress, in_chunks
from geokit.core.blocks.several_devices import LEAST_ON_GPUS
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Rows
from geokit.core.launches.late_checks import later
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.needs import rows
from geokit.core.memory.pinned import host_flags
from geokit.core.query.ask import query
from geokit.core.require import require_choice, require_flag
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.points import ClosestPoints, PointQueries, checked_radius, refuse_raised
from geokit.mesh.topology.size_limits import require_measurable

# Distance, in sizes of a closed mesh, from which on all points count as outside. From 1e16 on the distances to all
# triangles are equal in float64.
FAR = 1e9
SIGN_METHODS = ("auto", "winding", "pseudonormal", "parity")


class SignedDistances(NamedTuple):
    """The signed distance of each query point. Read fields by name: ClosestPoints begins with the points.

    Attributes:
        distance: Distances from the surface [world], negative inside, shape (N,).
        points: The closest points [world], shape (N, 3).
        triangle_id: Triangles that they lie on, shape (N,) int32.
        barycentric: Weights of the triangles' corners there, shape (N, 3).
    """

    distance: Array
    points: Array
    triangle_id: Array
    barycentric: Array


def _sign_bytes(self: Any, points: Any, **_: Any) -> float:
    """The first call prepares signs, from the connectivity of the mesh."""
    first = 0 if "_pseudonormals" in self.__dict__ or "_winding_tree" in self.__dict__ else 325 * self.mesh.face_count
    return max(124 * rows(points), first)


class SignQueries(PointQueries):
    """Queries of a :class:`geokit.mesh.Surface` that tell inside from outside."""

    audit: Any
    _of: Any
    _vertices: "wp.array"
    _faces: "wp.array"
    # Whether faces were left out that signs are still decided by.
    _is_trimmed = False

    @query(
        "points",
        gradient="..queries.gradients:SIGNED_DISTANCE",
        is_replayed=True,
        least_rows=LEAST_ON_GPUS,
        memory=_sign_bytes,
    )
    def signed_distance(
        self,
        points: Rows,
        *,
        sign: str = "auto",
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> SignedDistances:
        """Distance to the surface for each query point, negative inside.

        The magnitude is that of :meth:`closest_point`: to the nearest of all triangles, also to walls inside of the
        solid, as between bodies that touch. For distances to the boundary of the union make a Surface of
        :func:`geokit.mesh.union`. The sign is that of the mesh wound as by
        :func:`geokit.mesh.orient` (see ``orientation``). ``sign`` selects the method:

        - "auto": the method in ``sign_method``: "pseudonormal" if the mesh is proven clean, or encloses nothing and is
          wound alike (a terrain, a design surface, one side of a scanned wall: the distance is negative behind the
          faces, where their corners run clockwise); else "winding". ``sign_reason`` gives the reason. A UserWarning
          says where signs mean nothing: sheets that cannot be wound alike, that fork, or that are loose faces.
        - "pseudonormal": the angle-weighted normal at the closest face, edge or vertex, in float64. Exact on clean
          meshes and beside sheets; elsewhere the caller guarantees that the mesh is clean.
        - "winding": the generalized winding number against 1/2. On clean meshes right for points farther than 1e-6
          diagonals from the surface; on meshes with holes, flips, duplicates or overlaps it degrades gracefully.
          :meth:`sign_confidence` returns its margin.
        - "parity": an odd or even number of crossings along three rays, by majority. For closed meshes; nested and
          overlapping components count as holes.

        Some programs write each face twice, once for each side. Where two faces have the same three positions and
        opposite windings, they would cancel, and nothing would be inside. On closed components (found with one of the
        two) the earlier one counts alone, for every method; a component inside a solid is a contact or a core, and its
        faces cancel. Faces of open sheets, and of walls that meet others at edges of three faces, cancel too: a mesh of
        such faces alone has no inside. ``sign_reason`` says which faces are left out or cancel. Positions must be
        exactly equal (:func:`geokit.mesh.merge_vertices`). The two sides of a polygon may have different triangles if
        it is flat to 1e-3 radians and has the same corners on both.

        Open sheets that lie inside of closed bodies as a whole (decks, ribs, partitions), up to 1e-6 of the mesh's
        size, are left out where signs are decided: the bodies alone say what is inside. Distances are to them too.
        Sheets that reach out of a body count, and their winding numbers add up.

        Distances are within 1e-6 of the mesh's size, and signs right for points 1e-5 sizes from the surface, up to 1e9
        sizes from the origin. Queries may be 1e150 away (error 4e-15 of the distance), and all points farther than 1e9
        sizes from a closed mesh are outside. The two sides of a wall as thin as 1e-14 of the size, on a GPU 1e-11, get
        the right signs. Wrong signs on a damaged sphere, for points in 1.5 times its box: with a hole of 10% of its
        area under 3% by winding number, 2% by pseudonormals, 7% by parity; with small holes of 20% under 0.5% by
        winding number; with a triangle soup of which 10% are flipped under 1.5%; with copies and overlaps none.

        Args:
            points: Query points [world], shape (N, 3).
            sign: "auto", "pseudonormal", "winding" or "parity".
            max_distance: Search radius [world]; farther points have distance inf or -inf, triangle_id -1 and NaN
                elsewhere. Their signs are by winding number if ``sign`` is "pseudonormal".
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            SignedDistances with distance (N,) [world], points (N, 3) [world], triangle_id (N,), barycentric (N, 3).
        Raises:
            InputError: points is not (N, 3) or not finite, max_distance is negative or not a number, there is no such
                sign, or the transform is not rigid (to 1e-6) or is given beside tensors with gradients.
        Source:
            Bærentzen, Aanæs, "Signed Distance Computation Using the Angle Weighted Pseudonormal" (2005); Jacobson,
            Kavan, Sorkine-Hornung, "Robust Inside-Outside Segmentation using Generalized Winding Numbers" (2013);
            Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018).
        Example:
            >>> bracket = gk.mesh.load("data/samples/bracket.obj")
            >>> surface = gk.mesh.Surface(bracket, device="cpu")
            >>> surface.signed_distance(bracket.bounds[1:] + [[0, 0, 1]]).distance > 0
            array([ True])
        """
        method, reach = self._method(sign), checked_radius(max_distance)
        require_measurable(self.mesh, self._frame)

        def query(batch: user_arrays.Batch) -> SignedDistances:
            bad = host_flags(1, self._device)
            closest = self._closest(batch.rows, reach, bad)
            # Pseudonormals use what was found; the other methods would search long for a point that is not finite.
            if method != "pseudonormal":
                refuse_raised(bad, batch)
            self._sign(method, batch.rows, closest, reach)
            found = closest.distance, closest.points, closest.triangle_id, closest.barycentric
            answer = SignedDistances(*(batch.to_caller(array) for array in found))
            later(lambda: refuse_raised(bad, batch), self._device)
            return answer

        return in_chunks(query, [points], ["points"], self._device, progress, defer=True)

    @query("points", is_replayed=True, is_stepped=True, least_rows=LEAST_ON_GPUS, memory=_sign_bytes)
    def contains(
        self, points: Rows, *, sign: str = "auto", transform: ArrayLike | None = None, progress: Progress | None = None
    ) -> Array:
        """True for points inside, by the same sign as :meth:`signed_distance`; points on the surface are outside.

        Args:
            points: Query points [world], shape (N, 3).
            sign: "auto", "pseudonormal", "winding" or "parity"; see :meth:`signed_distance`.
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            bool (N,).
        Raises:
            InputError: points is not (N, 3) or not finite, there is no such sign, or the transform is not rigid (to
                1e-6) or is given beside tensors with gradients.
        """
        from geokit.mesh.sign.parity_kernels import is_negative_kernel

        if self._signs is not self:
            return self._signs.contains(points, sign=sign, progress=progress)
        method, device = self._method(sign), self._device
        by_closest = method == "pseudonormal"
        require_measurable(self.mesh, self._frame)

        def query(batch: user_arrays.Batch) -> Any:
            count = len(batch)
            bad = host_flags(1, device)
            found = self._judged(method, batch.rows, math.inf, bad)
            refuse_raised(bad, batch)
            if isinstance(found.distance, HostArray):  # a launch takes longer than this does for thousands of points
                return batch.to_caller(user_arrays.mapped(found.distance, lambda distance: distance < 0.0))
            inside = user_arrays.empty(count, wp.bool, batch.rows)
            launcher.launch(is_negative_kernel, count, [found.distance], [inside], device)
            return batch.to_caller(inside)

        return in_chunks(query, [points], ["points"], device, progress, defer=by_closest)

    @query(
        "points",
        gradient=".gradients:WINDING_NUMBER",
        is_replayed=True,
        least_rows=LEAST_ON_GPUS,
        memory=lambda self, points, **_: 100 * self.mesh.face_count + 32 * rows(points),
    )
    def winding_number(
        self,
        points: Rows,
        *,
        as_given: bool = False,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Array:
        """Generalized winding number: 1 inside a closed mesh, 0 outside, in between around holes.

        This is the number of the mesh wound as by :func:`geokit.mesh.orient` (``orientation`` says whether that flips
        faces), with doubled faces counted once and without open sheets inside of closed bodies (see
        :meth:`signed_distance`), because signs are decided by it.
        ``as_given=True`` takes all faces with the winding that they have in ``mesh``: -1 inside a closed mesh that
        is inside out, and 0 for faces that lie back to back.

        On a CPU within 0.005 of the exact sum, k times that where k surfaces coincide. On CUDA within 0.02 of it from
        1e-6 of the mesh's size away from the surface; nearer, float32 does not tell the side: at 1e-7 within 0.03, at
        1e-8 up to 1 off, and at more where several surfaces meet.

        Args:
            points: Query points [world], shape (N, 3).
            as_given: Whether faces keep the winding that they have in ``mesh``.
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
            progress: Called as ``progress(done, total)`` after each block of a few million queries.
        Returns:
            float (N,).
        Raises:
            InputError: points is not (N, 3) or not finite, or the transform is not rigid (to 1e-6) or is given beside
                tensors with gradients.
        Source:
            Barill et al., "Fast Winding Numbers for Soups and Clouds" (2018). Differs: on a CPU harmonic moments of
            three orders and exact solid angles nearby, in float64 next to triangles.
        """

        require_flag(as_given, "as_given")
        arguments = self._winding_arguments_as_given() if as_given else self._winding_arguments()

        def query(batch: user_arrays.Batch) -> Any:
            bad = host_flags(1, self._device)
            winding = self._winding(batch.rows, bad, arguments)
            refuse_raised(bad, batch)
            return batch.to_caller(winding)

        return in_chunks(query, [points], ["points"], self._device, progress, defer=True)

    @query(
        "points",
        is_replayed=True,
        least_rows=LEAST_ON_GPUS,
        memory=lambda self, points, **_: 100 * self.mesh.face_count + 40 * rows(points),
    )
    def sign_confidence(self, points: Rows, *, transform: ArrayLike | None = None) -> Array:
        """Margin of the sign by winding number: the distance of the winding number from 1/2.

        1/2 or more where the winding number is a whole one; near 0 in the holes of an open mesh, where either sign may
        be right. It measures how open the mesh is as seen from a point, not whether the sign is right: single open
        sheets that are not inside of a closed body add up, and a wrong sign beside them may have a margin of 0.4.

        Args:
            points: Query points [world], shape (N, 3).
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
        Returns:
            float (N,).
        Raises:
            InputError: points is not (N, 3) or not finite, or the transform is not rigid (to 1e-6).
        """
        from geokit.mesh.sign.parity_kernels import confidence_kernel

        batch = user_arrays.read_vectors(points, "points", self._device, defer=True, pin=True, single=True)
        confidence = user_arrays.empty(len(batch), wp.float64, batch.rows)
        bad = host_flags(1, self._device)
        winding = self._winding(batch.rows, bad)
        launcher.launch(confidence_kernel, len(batch), [winding], [confidence], self._device)
        refuse_raised(bad, batch)
        return batch.to_caller(confidence)

    @property
    def sign_method(self) -> str:
        """The method behind ``sign="auto"``: "pseudonormal" if the mesh is proven clean, or a sheet, else "winding".

        A mesh is a sheet if it encloses nothing: the winding numbers on the two sides of its faces add up to less than
        1/2 on the mean (0 for a plane, 0.6 for a hemisphere, 1 for closed bodies), and no part of it is closed. A mesh
        is proven clean if every edge joins two faces with the same winding (flipped where ``orientation`` says
        so), the faces around each vertex form one fan, no face is without area, a duplicate, or intersects another one,
        and nested components are cavities. Computed at the first access.
        """
        return self._sign_choice.method

    @property
    def sign_reason(self) -> str:
        """The reason for ``sign_method``: faces that are left out, and what was proven or the first defect found."""
        return self._sign_choice.reason

    @cached_property
    def _sign_choice(self) -> Any:
        """Of queries, which tell the sides of sheets too."""
        from geokit.mesh.sign.choice import choose_side

        return choose_side(self) if self._signs is self else self._with_left_out(self._signs._sign_choice)

    @cached_property
    def _solid_choice(self) -> Any:
        """Of what the mesh encloses; a sheet encloses nothing."""
        from geokit.mesh.sign.choice import choose_sign

        return choose_sign(self) if self._signs is self else self._with_left_out(self._signs._solid_choice)

    def _with_left_out(self, choice: Any) -> Any:
        counted = self._counted
        for more, fewer, what in (
            (counted, self._signs, "faces of open sheets inside of bodies"),
            (self, counted, "faces back to back with others"),
        ):
            if count := more.mesh.face_count - fewer.mesh.face_count:
                choice = choice._replace(reason=f"{count} {what} are left out; {choice.reason}")
        return choice

    @property
    def _counted(self) -> Any:
        """The surface whose faces count once each: this one, or that without faces back to back with others."""
        return self._single_faced or self

    @property
    def _signs(self) -> Any:
        """The surface that decides signs: that whose faces count, without open sheets inside of its bodies."""
        counted = self._counted
        return counted._without_sheets or counted

    @cached_property
    def _single_faced(self) -> Any:
        """The surface of the mesh without faces back to back with others; None if there are none to leave out."""
        from geokit.mesh.sign.left_out import left_out_faces

        left_out = left_out_faces(self)  # type: ignore[arg-type]
        if not len(left_out):
            return None
        return self._without(left_out)

    @cached_property
    def _without_sheets(self) -> Any:
        """The surface of the mesh without open sheets inside of closed bodies; None if there are none."""
        from geokit.mesh.sign.left_out import inner_sheets

        rows = inner_sheets(self)  # type: ignore[arg-type]
        if not len(rows):
            return None
        found = self._without(rows)
        found.__dict__["_without_sheets"] = None  # what is left lies outside
        return found

    def _without(self, rows: NDArray[np.int64]) -> Any:
        faces = np.delete(self.mesh.faces, rows, axis=0)
        found = self._of(TriangleMesh(self.mesh.vertices, faces, name=self.mesh.name), device=self._device)
        found._left_out = rows
        return found

    @cached_property
    def _outward(self) -> NDArray[np.int32]:
        """1 for faces whose winding shows outward as signs do, -1 for inward, 0 for those without area, (F,)."""
        from geokit.mesh.sign.left_out import INNER_POINT
        from geokit.mesh.topology.measures import faces_without_area
        from geokit.mesh.topology.normals import face_normals

        mesh, fewer = self.mesh, self._single_faced or self._without_sheets
        outward = np.where(self._orientation.flipped, -1, 1).astype(np.int32)
        if fewer is not None:
            rows = fewer._left_out
            outward[np.delete(np.arange(len(outward)), rows)] = fewer._outward
            if fewer is self._single_faced:
                # A face that was left out lies on one that counts, wound as it or against it.
                on = fewer.closest_point(INNER_POINT @ mesh.vertices[mesh.faces[rows]]).triangle_id
                along = np.einsum("ij,ij->i", face_normals(mesh)[rows], face_normals(fewer.mesh)[on])
                outward[rows] = np.where(along < 0.0, -1, 1) * fewer._outward[on]
        outward[faces_without_area(mesh)] = 0
        return outward

    @property
    def is_closed(self) -> bool:
        """True if the mesh is closed: every edge joins exactly two triangles, with the same winding.

        The winding is that after :func:`geokit.mesh.orient`, and faces that lie back to back count once, as in
        :meth:`signed_distance`. Winding numbers of a closed mesh are whole numbers, and 0
        far away. Closed meshes are watertight (:func:`geokit.mesh.audit`), but may have non-manifold vertices and
        self-intersections.
        """
        return bool(self._counted._orientation.closed)

    @property
    def orientation(self) -> int:
        """1 if all faces keep their winding, -1 if all are flipped (the mesh is inside out), 0 if only some are
        flipped.

        Signs and winding numbers are those of the mesh that :func:`geokit.mesh.orient` returns; rays ignore the
        winding.
        """
        flipped: NDArray[np.bool_] = self._counted._orientation.flipped
        if not flipped.any():
            return 1
        return -1 if flipped.all() else 0

    @cached_property
    def _orientation(self) -> Any:
        from geokit.mesh.topology.orientation import orient_faces

        surface: Any = self  # a Surface, of which this class is a base
        return orient_faces(self.mesh, partial(surface._of, device="cpu"), surface=surface, known=self._topology)

    @cached_property
    def _topology(self) -> Any:
        from geokit.mesh.topology.connectivity import mesh_topology

        return mesh_topology(self.mesh)

    @cached_property
    def _pseudonormals(self) -> Any:
        from geokit.mesh.sign.pseudonormals import pseudonormal_tables

        flipped = self._orientation.flipped
        tables = pseudonormal_tables(self.mesh, self._topology, flipped, self._vertices, self._faces)
        # The topology takes more memory than the mesh, and nothing else uses it.
        self.__dict__.pop("_topology", None)
        return tables

    def _method(self, sign: str) -> str:
        require_choice(sign, "sign", SIGN_METHODS)
        if sign != "auto":
            return sign
        method, reason, means_nothing = self._sign_choice
        if means_nothing and self.__dict__.setdefault("_says_so", True):
            self.__dict__["_says_so"] = False
            warn(
                f"{self.mesh.name or 'mesh'}: {reason}, so that the signs of its distances mean nothing; "
                "closest_point has distances without signs, and a sign method by name is silent"
            )
        return str(method)

    def _solid_method(self, sign: str) -> str:
        """The method for what the mesh encloses; that of a sheet says nothing."""
        require_choice(sign, "sign", SIGN_METHODS)
        return self._solid_choice.method if sign == "auto" else sign

    def _sign(self, method: str, points: "wp.array", closest: ClosestPoints, reach: float) -> None:
        """Negate the distances of inside points in place; ``reach`` is the search radius."""
        from geokit.mesh.sign import parity
        from geokit.mesh.sign.parity_kernels import missed_sign_kernel, take_sign_kernel
        from geokit.mesh.sign.pseudonormals_kernels import pseudonormal_sign_kernel

        if self._signs is not self:
            judged = self._signs._judged(method, points, reach, host_flags(1, self._device))
            launcher.launch(take_sign_kernel, len(points), [judged.distance], [closest.distance], self._device)
            return
        if method == "pseudonormal":
            count, device, out = len(points), self._device, [closest.distance]
            # Very far away float64 no longer tells which triangle is closest, and so on which side a point is.
            outside = FAR * self._frame.scale if self.is_closed else math.inf
            inputs = [points, closest.points, closest.triangle_id, closest.barycentric, self._pseudonormals]
            launcher.launch(pseudonormal_sign_kernel, count, [*inputs, wp.float64(outside)], out, device)
            # Without a search radius only points 1e150 away can be misses, and those are outside.
            if reach < math.inf and parity.any_missed(closest.triangle_id):
                # The search for closest points has already checked for points that are not finite.
                winding = self._winding(points, host_flags(1, device))
                launcher.launch(missed_sign_kernel, count, [winding, closest.triangle_id], out, device)
        elif method == "winding":
            from geokit.mesh.bvh.winding_kernels import sign_kernel

            self._query(sign_kernel, points, self._winding_arguments(), [closest.distance])
        else:
            parity.by_parity(self, points, closest.distance)

    def _judged(self, method: str, points: Any, reach: float, bad: HostArray) -> ClosestPoints:
        """Distances that are negative inside; without closest points where the method needs none."""
        if method == "pseudonormal":
            found = self._closest(points, reach, bad)
        else:
            nothing: Any = None
            found = ClosestPoints(nothing, user_arrays.full(len(points), 1.0, wp.float64, points), nothing, nothing)
        self._sign(method, points, found, reach)
        return found

    def _winding(self, points: "wp.array", bad: HostArray, arguments: list[Any] | None = None) -> "wp.array":
        """Winding numbers; ``bad`` is raised if a point is not finite, and such a point has no number."""
        from geokit.mesh.bvh.winding_kernels import winding_number_kernel

        winding = user_arrays.empty(len(points), wp.float64, points)
        arguments = self._winding_arguments() if arguments is None else arguments
        self._query(winding_number_kernel, points, arguments, [winding], flag=bad)
        return winding

    @cached_property
    def _winding_tree(self) -> Any:
        from geokit.mesh.bvh.winding_moments import build_winding_tree, winding_tree_of_mesh

        flipped: NDArray[np.bool_] = self._orientation.flipped
        if not flipped.any():
            return self._winding_tree_as_given
        if self._device.is_cpu:
            return build_winding_tree(self._tree, flipped)
        faces = np.where(flipped[:, None], self.mesh.faces[:, ::-1], self.mesh.faces).reshape(-1)
        turned: Any = wp.array(faces, dtype=wp.int32, device=self._device)
        # The handle does not keep the mesh alive, so the surface must; threads that come together keep the same one.
        made = self._make_warp_mesh(turned)  # type: ignore[attr-defined]
        return winding_tree_of_mesh(self.__dict__.setdefault("_turned_mesh", made))

    @cached_property
    def _winding_tree_as_given(self) -> Any:
        from geokit.mesh.bvh.winding_moments import build_winding_tree, winding_tree_of_mesh

        if self._device.is_cpu:
            return build_winding_tree(self._tree)
        return winding_tree_of_mesh(self._warp_mesh)  # type: ignore[attr-defined]

    def _winding_arguments(self) -> list[Any]:
        arguments: list[Any] = self._signs._winding_arguments_of_all()
        return arguments

    def _winding_arguments_of_all(self) -> list[Any]:
        """Those of all faces of this mesh, wound as ``orientation`` says."""
        # The winding number of a closed mesh is zero everywhere outside its box.
        empty = 1.0 if self._orientation.closed else math.inf
        return [self._tree, self._winding_tree, wp.float64(empty)]

    def _winding_arguments_as_given(self) -> list[Any]:
        whole = self._orientation.closed and self._orientation.flipped.mean() in (0.0, 1.0)
        return [self._tree, self._winding_tree_as_given, wp.float64(1.0 if whole else math.inf)]
