"""Many meshes prepared for queries: one call asks all of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.gradients.rules import hold, is_tracked, split
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.needs import needs, rows
from geokit.core.memory.pinned import host_flags
from geokit.core.memory.struct_array import struct_array, struct_rows
from geokit.core.poses.move import move_packed, require_rigid_maps
from geokit.core.query.ask import query
from geokit.core.require import described, read_array, require_choice, require_count, require_items
from geokit.errors import InputError
from geokit.mesh.bvh.bvh8 import offsets_of
from geokit.mesh.model.triangle_mesh import TriangleMesh, trusted_mesh
from geokit.mesh.queries.points import QUERY_GROUP, ClosestPoints, checked_radius, refuse_raised
from geokit.mesh.queries.rays import RayHits, checked_limits, group_size
from geokit.mesh.sign.queries import SIGN_METHODS, SignedDistances
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.size_limits import LARGEST_SCALE, LEAST_SCALE, require_measurable

# Of a tree while it is built, of signs while they are prepared, and of one surface beside the common tree, on a CPU.
BYTES_PER_FACE = 240
SIGN_BYTES_PER_FACE = 165
OWN_BYTES_PER_FACE = 40


def _bytes(self: Any, meshes: Any, **_: Any) -> float:
    packed = isinstance(meshes, tuple) and len(meshes) == 3 and not isinstance(meshes[0], TriangleMesh)
    return BYTES_PER_FACE * (rows(meshes[1]) if packed else sum(mesh.face_count for mesh in meshes))


def _sign_bytes(self: Any, *_: Any, **__: Any) -> int:
    return SIGN_BYTES_PER_FACE * len(self._faces)


class Surfaces:
    """Many meshes prepared once, which one call asks: query points or rays are packed, with offsets.

    Answers equal those of a :class:`geokit.mesh.Surface` of each mesh to the last bit. On a CPU ten thousand meshes of
    12 to 480 faces are built 20 times as fast as one after another. Queries of 50 points a mesh are 5 to 13 times as
    fast as first calls of single surfaces, and 1.7 to 3 times as fast as later ones; of 4 points, 24 and 7 to 15 times.
    On a GPU trees are built one after another; queries are one launch.

    Closest points, signed distances and first hits carry gradients, as those of a single surface do; see
    docs/gradients.md.

    Signs of meshes that are one component of faces wound alike, without repeated faces, are prepared together; those of
    others one by one, at the first call that needs them.

    Args:
        meshes: The meshes, as :class:`geokit.mesh.Surface` takes them; or a tuple (vertices, faces, offsets) of packed
            arrays: vertices (V, 3) [world], faces (F, 3) whose numbers are rows of ``vertices``, and offsets (B + 1,)
            from 0 to F: mesh m has the faces from ``offsets[m]`` to ``offsets[m + 1]``. Packed vertices that are a
            torch tensor or an array of warp with gradients are kept as such: answers carry gradients for them.
        device: "cpu", "cuda:0", a device of warp, torch, JAX or CuPy, or None for the first GPU, else the CPU.
    Raises:
        InputError: There is no mesh, a mesh has no faces, an array is not as above, or there is no such device.
        DeviceMemoryError: The device cannot hold the meshes.
    Example:
        >>> meshes = [gk.mesh.sphere(radius, segments=8) for radius in (1.0, 2.0)]
        >>> surfaces = gk.mesh.Surfaces(meshes, device="cpu")
        >>> surfaces.contains([[0, 0, 1.5], [0, 0, 1.5], [0, 0, 2.5]], [0, 1, 3])
        array([False,  True, False])
    """

    _cache = CacheAttribute()

    @needs(_bytes)
    def __init__(self, meshes: Any, *, device: Device = None) -> None:
        self._device = launcher.resolve_device(device)
        self._given: list[TriangleMesh] | None
        if isinstance(meshes, tuple) and len(meshes) == 3 and not isinstance(meshes[0], TriangleMesh):
            self._given = None
            plain, tracked = split(meshes[0])
            if is_tracked(plain):
                raise InputError("meshes: vertices that jax traces; make a geokit.jax.Surface of each mesh")
            whole = require_mesh((plain, meshes[1]), "meshes", images=False)
            self._vertices, self._faces, self._begin = _unpacked(whole, meshes[2])
            if tracked is not None:
                # Answers carry gradients for the rows that were given, which meshes may share.
                hold(self, vertices=tracked)
                self._cache.keep("packed", (whole.vertices, whole.faces))
        else:
            self._given = _each(meshes)
            vertex_begin = offsets_of([mesh.vertex_count for mesh in self._given])
            self._begin = offsets_of([mesh.face_count for mesh in self._given])
            self._vertices = np.concatenate([mesh.vertices for mesh in self._given])
            shift = np.repeat(vertex_begin[:-1], np.diff(self._begin)).astype(np.int32)
            self._faces = np.concatenate([mesh.faces for mesh in self._given]) + shift[:, None]
        none = np.flatnonzero(np.diff(self._begin) == 0)
        if len(none):
            raise InputError(f"meshes: mesh {none[0]} has no faces; queries need at least one triangle")
        self._prepare()

    def _prepare(self) -> None:
        from geokit.mesh.bvh.forest import Forest

        self._bounds = _boxes(self._vertices, self._faces, self._begin)
        half = self._bounds * 0.5
        self._scales = (half[:, 1] - half[:, 0]).max(axis=1)
        self._scales[self._scales == 0.0] = 1.0
        self._forest: Forest | None = None
        self._surfaces: dict[int, Surface] = {}
        if self._device.is_cuda:
            # Warp builds a tree in some launches of its own.
            self._uploaded: Any = None
            self._surfaces = {mesh: Surface(self.mesh(mesh), device=self._device) for mesh in range(len(self))}
            return
        vertices: Any = wp.array(self._vertices, dtype=wp.vec3d, device=self._device)
        faces: Any = wp.array(self._faces.ravel(), dtype=wp.int32, device=self._device)
        self._uploaded = vertices, faces
        self._forest = Forest(vertices, faces, self._begin, half[:, 0] + half[:, 1], self._scales)

    def __len__(self) -> int:
        return len(self._begin) - 1

    def __repr__(self) -> str:
        return f"Surfaces({len(self)} meshes, {len(self._faces)} faces, device={self.device!r})"

    def __reduce__(self) -> Any:
        # Trees hold addresses: they are built again where they arrive.
        packed = self._vertices, self._faces, self._begin
        return _restored, (packed if self._given is None else self._given, self.device)

    @property
    def device(self) -> str:
        """Alias of the device: "cpu", "cuda:0", ..."""
        return self._device.alias

    @needs()
    def mesh(self, index: int) -> TriangleMesh:
        """One of the meshes.

        Args:
            index: Its number, from 0.
        Raises:
            InputError: There is no such mesh.
        """
        index = require_count(index, "index", 0, len(self) - 1)
        if self._given is not None:
            return self._given[index]
        faces = self._faces[self._begin[index] : self._begin[index + 1]]
        used, corners = np.unique(faces, return_inverse=True)
        return trusted_mesh(self._vertices[used], corners.reshape(-1, 3).astype(np.int32), "", ())

    @needs(lambda self, index: OWN_BYTES_PER_FACE * int(self._begin[index + 1] - self._begin[index]), late=True)
    def surface(self, index: int) -> Surface:
        """A :class:`geokit.mesh.Surface` of one of the meshes; a new one each time, on a CPU over the same tree.

        Args:
            index: Its number, from 0.
        Raises:
            InputError: There is no such mesh.
            DeviceMemoryError: The GPU cannot hold another tree.
        """
        index = require_count(index, "index", 0, len(self) - 1)
        if self._forest is None:
            return Surface(self.mesh(index), device=self._device)
        return Surface._over(self.mesh(index), self._device, self._forest.tree(index))

    def _own(self, index: int) -> Surface:
        # Users may update what `surface` gives them; nobody else has this one.
        if index not in self._surfaces:
            self._surfaces.setdefault(index, self.surface(index))
        return self._surfaces[index]

    @query("points", gradient="..queries.gradients:CLOSEST_POINT_OF_MANY", row_bytes=80)
    def closest_point(
        self,
        points: Rows,
        offsets: ArrayLike | None = None,
        *,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
    ) -> ClosestPoints:
        """Closest point on its surface for each query point; see :meth:`geokit.mesh.Surface.closest_point`.

        Args:
            points: Query points [world], packed (N, 3); or (B, N, 3), as many for each mesh, which gives results of
                shape (B, N) and (B, N, 3).
            offsets: Mesh m is asked the points from ``offsets[m]`` to ``offsets[m + 1]``, (B + 1,) from 0 to N; None
                for points of shape (B, N, 3).
            max_distance: Search radius [world]; farther points are misses.
            transform: Where they are: a rigid map or mirror for column vectors for each mesh, shape (B, 4, 4).
                Arguments and answers are in world coordinates; moving them rounds each to 1e-15 of its size. None
                leaves the meshes in place.
        Returns:
            ClosestPoints; each ``triangle_id`` is a row of its mesh's faces.
        Raises:
            InputError: points is not of such a shape or not finite, offsets do not fit, max_distance is negative or not
                a number, a map is not rigid (to 1e-6) or is given beside tensors with gradients, or a mesh is smaller
                than 1e-70 or larger than 1e70.
        """
        return self._found(points, offsets, None, max_distance, transform)

    @query("points", gradient="..queries.gradients:SIGNED_DISTANCE_OF_MANY", row_bytes=124, memory=_sign_bytes)
    def signed_distance(
        self,
        points: Rows,
        offsets: ArrayLike | None = None,
        *,
        sign: str = "auto",
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
    ) -> SignedDistances:
        """Distance to its surface for each query point, negative inside; see
        :meth:`geokit.mesh.Surface.signed_distance`.

        Args:
            points, offsets: As for :meth:`closest_point`.
            sign: "auto" (the method of each mesh), "pseudonormal", "winding" or "parity".
            max_distance: Search radius [world]; farther points have distance inf or -inf, and triangle_id -1.
            transform: As for :meth:`closest_point`.
        Returns:
            SignedDistances; each ``triangle_id`` is a row of its mesh's faces.
        Raises:
            InputError: As for :meth:`closest_point`, or there is no such sign.
        """
        require_choice(sign, "sign", SIGN_METHODS)
        found = self._found(points, offsets, sign, max_distance, transform)
        return SignedDistances(found.distance, found.points, found.triangle_id, found.barycentric)

    @query("points", is_stepped=True, row_bytes=124, memory=_sign_bytes)
    def contains(
        self, points: Rows, offsets: ArrayLike | None = None, *, sign: str = "auto", transform: ArrayLike | None = None
    ) -> Array:
        """True for points inside their mesh; see :meth:`geokit.mesh.Surface.contains`.

        Args:
            points, offsets: As for :meth:`closest_point`.
            sign: "auto" (the method of each mesh), "pseudonormal", "winding" or "parity".
            transform: As for :meth:`closest_point`.
        Returns:
            bool (N,) or (B, N).
        Raises:
            InputError: points is not of such a shape or not finite, offsets do not fit, there is no such sign, or a map
                is not rigid (to 1e-6) or is given beside tensors with gradients.
        """
        from geokit.mesh.sign.parity_kernels import is_negative_kernel

        require_choice(sign, "sign", SIGN_METHODS)
        self._require_measurable()
        maps = self._maps(transform)
        batch, where, shaped = self._read(points, offsets, "points", maps, defer=False)
        asked = self._by_pseudonormal(sign)
        found = self._closest(batch, where, asked, math.inf, host_flags(1, self._device), 1.0)
        self._sign(sign, batch, where, found, math.inf)
        inside = user_arrays.empty(len(batch), wp.bool, batch.rows)
        launcher.launch(is_negative_kernel, len(batch), [found.distance], [inside], self._device)
        return shaped(batch.to_caller(inside))

    @query("origins", "directions", gradient="..queries.gradients:RAYCAST_OF_MANY", row_bytes=52)
    def raycast(
        self,
        origins: Rows,
        directions: Rows,
        offsets: ArrayLike | None = None,
        *,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
    ) -> RayHits:
        """First hit of each ray on its surface; see :meth:`geokit.mesh.Surface.raycast`.

        Args:
            origins: Starts of the rays [world], packed (N, 3); or (B, N, 3), as many for each mesh.
            directions: Directions of any length [world], of the same shape, or one of shape (3,) for all.
            offsets: Mesh m is asked the rays from ``offsets[m]`` to ``offsets[m + 1]``, (B + 1,) from 0 to N; None for
                rays of shape (B, N, 3).
            t_min: Hits with a smaller t are ignored, in units of the direction.
            max_distance: Length of the rays [world]; farther hits are misses.
            transform: As for :meth:`closest_point`.
        Returns:
            RayHits; each ``triangle_id`` is a row of its mesh's faces.
        Raises:
            InputError: An array is not of such a shape or not finite, their lengths differ, a direction is zero,
                offsets do not fit, t_min is negative or not finite, max_distance is negative or not a number, a map is
                not rigid (to 1e-6) or is given beside tensors with gradients, or a mesh is smaller than 1e-70 or larger
                than 1e70.
        """
        from geokit.mesh.bvh.ray_walk_kernels import SHORTEST_DIRECTION
        from geokit.mesh.queries.forest_raycast_kernels import forest_raycast_kernel

        self._require_measurable()
        maps = self._maps(transform)
        origins, directions = user_arrays.same_rows([origins, directions], ["origins", "directions"])
        rays, where, shaped = self._read(origins, offsets, "origins", maps)
        heading, _, _ = self._read(directions, offsets, "directions", maps, turned=True)
        found = [user_arrays.empty(len(rays), kind, rays.rows) for kind in (wp.float64, wp.int32, wp.vec3d)]
        limits, bad = checked_limits(rays, heading, t_min, max_distance), host_flags(2, self._device)
        group = group_size(len(rays)) if self._device.is_cpu else 1
        trees = self._cache.find("ray trees", lambda: self._structs(True))
        inputs = [group, where, rays.rows, heading.rows, trees, *limits]
        launcher.launch(forest_raycast_kernel, -(-len(rays) // group), inputs, [*found, bad], self._device, grain=1)
        user_arrays.refuse_rays(bad, rays, heading, SHORTEST_DIRECTION)
        return RayHits(*(shaped(rays.to_caller(array)) for array in found))

    # In the cache, which copies without tensors share.
    @property
    def _packed(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        return self._cache.find("packed", lambda: (self._vertices, self._faces))

    @property
    def _trees(self) -> "wp.array":
        return self._cache.find("trees", lambda: self._structs(False))

    def _structs(self, rays: bool) -> "wp.array":
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        if self._forest is None:
            table = struct_rows(SurfaceTree, (self._surfaces[mesh]._tree for mesh in range(len(self))))
        else:
            table = self._forest.ray_table if rays else self._forest.table
        return struct_array(table, SurfaceTree, self._device)

    @property
    def _signs(self) -> Any:
        from geokit.mesh.sign.forest_signs import ForestSigns

        arrays = self._vertices, self._faces, self._begin, self._bounds
        given = len(self), self._device, arrays, self._uploaded, self._forest, self._own
        return self._cache.find("signs", lambda: ForestSigns(*given))

    def _require_measurable(self) -> None:
        if not (self._scales.min() >= LEAST_SCALE and self._scales.max() <= LARGEST_SCALE):
            index = int(np.argmax((self._scales < LEAST_SCALE) | (self._scales > LARGEST_SCALE)))
            surface = self._own(index)
            require_measurable(surface.mesh, surface._frame)

    def _found(self, points: Any, offsets: Any, sign: str | None, max_distance: float, transform: Any) -> ClosestPoints:
        """Closest points as callers get them, with distances that a sign method has signed."""
        reach = checked_radius(max_distance)
        self._require_measurable()
        maps = self._maps(transform)
        batch, where, shaped = self._read(points, offsets, "points", maps)
        bad = host_flags(1, self._device)
        found = self._closest(batch, where, np.ones(len(self), bool), reach, bad)
        # The other searches take long for a point that is not finite.
        refuse_raised(bad, batch)
        if sign is not None:
            self._sign(sign, batch, where, found, reach)
        if maps is not None:
            found = found._replace(points=move_packed(found.points, where, maps))
        return ClosestPoints(*(shaped(batch.to_caller(array)) for array in found))

    def _maps(self, transform: Any) -> NDArray[np.float64] | None:
        """Where the meshes are; None if in place."""
        return None if transform is None else require_rigid_maps(transform, len(self))

    def _read(
        self,
        values: Any,
        offsets: Any,
        name: str,
        maps: NDArray[np.float64] | None = None,
        *,
        turned: bool = False,
        defer: bool = True,
    ) -> Any:
        """The rows beside their meshes, the offsets on the device, and what gives results their leading axes."""
        count, shaped = len(self), lambda out: out
        if offsets is None:
            if not hasattr(values, "shape"):
                values = read_array(values, name)
            shape = tuple(values.shape)
            if len(shape) != 3 or shape[0] != count or shape[2] != 3:
                raise InputError(
                    f"{name}: shape {shape} is not ({count}, N, 3), as many rows for each mesh; give offsets for others"
                )
            values, where = values.reshape((count * shape[1], 3)), np.arange(count + 1) * shape[1]
            shaped = lambda out: out.reshape((*shape[:2], *out.shape[1:]))  # noqa: E731
        largest = user_arrays.LARGEST_MEASURED
        batch = user_arrays.read_vectors(values, name, self._device, defer=defer and maps is None, largest=largest)
        if offsets is not None:
            where = _read_offsets(offsets, count, len(batch), "offsets", name)
        starts = self._on_device(where.astype(np.int32))
        if maps is not None:
            to_meshes: Any = np.linalg.inv(maps)
            batch = replace(batch, rows=move_packed(batch.rows, starts, to_meshes, turned=turned))
            if not defer:
                user_arrays.require_finite(batch, name, largest)
        return batch, starts, shaped

    def _closest(
        self,
        batch: user_arrays.Batch,
        where: Any,
        asked: NDArray[np.bool_],
        reach: float,
        bad: Any,
        others: float | None = None,
    ) -> ClosestPoints:
        """Closest points of the meshes that are asked; the distances of others are ``others``."""
        from geokit.mesh.queries.forest_closest_kernels import forest_closest_kernel

        count, like = len(batch), batch.rows
        kinds = (wp.vec3d, wp.float64, wp.int32, wp.vec3d)
        found = ClosestPoints(*(user_arrays.empty(count, kind, like) for kind in kinds))
        if others is not None:
            found = found._replace(distance=user_arrays.full(count, others, wp.float64, like))
        if asked.any():
            group = QUERY_GROUP if self._device.is_cpu else 1
            inputs = [group, where, self._on_device(asked), like, self._trees, wp.float64(reach)]
            launcher.launch(forest_closest_kernel, -(-count // group), inputs, [*found, bad], self._device, grain=16)
        return found

    def _on_device(self, values: NDArray[Any]) -> Any:
        return HostArray(values) if self._device.is_cpu else wp.array(values, device=self._device)

    def _by_pseudonormal(self, sign: str) -> NDArray[np.bool_]:
        if sign == "auto":
            chosen: NDArray[np.bool_] = self._signs.by_pseudonormal
            return chosen
        return np.full(len(self), sign == "pseudonormal")

    def _sign(self, sign: str, batch: user_arrays.Batch, where: Any, found: ClosestPoints, reach: float) -> None:
        """Negate the distances of inside points in place."""

        from geokit.mesh.bvh.winding_kernels import WindingTree
        from geokit.mesh.sign import parity
        from geokit.mesh.sign.forest_winding_kernels import forest_missed_kernel, forest_winding_kernel
        from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals, forest_pseudonormal_kernel

        signs, device, count, points = self._signs, self._device, len(batch), batch.rows
        apart = np.full(len(self), True) if sign == "parity" else signs.apart
        chosen = self._by_pseudonormal(sign)
        by_normal, by_winding = chosen & ~apart, ~chosen & ~apart
        out = [found.distance]

        def winding(meshes: NDArray[np.bool_]) -> list[Any]:
            table = struct_array(signs.windings(meshes), WindingTree, device)
            return [self._trees, table, self._on_device(signs.empty)]

        if by_normal.any():
            table = struct_array(signs.pseudonormals(by_normal), Pseudonormals, device)
            flags = self._on_device(by_normal)
            inputs = [where, flags, points, found.points, found.triangle_id, found.barycentric]
            inputs += [table, self._on_device(signs.outside)]
            launcher.launch(forest_pseudonormal_kernel, count, inputs, out, device)
            if reach < math.inf and parity.any_missed(found.triangle_id):
                inputs = [where, flags, points, found.triangle_id, *winding(by_normal)]
                launcher.launch(forest_missed_kernel, count, inputs, out, device)
        if by_winding.any():
            inputs = [where, self._on_device(by_winding), points, *winding(by_winding)]
            launcher.launch(forest_winding_kernel, count, inputs, out, device, grain=64)
        bounds = where.values if isinstance(where, HostArray) else where.numpy()
        for mesh in np.flatnonzero(apart & (np.diff(bounds) > 0)):
            part = slice(int(bounds[mesh]), int(bounds[mesh + 1]))
            surface = self._own(int(mesh))
            closest = ClosestPoints(*(array[part] for array in found))
            surface._sign(surface._method(sign), points[part], closest, reach)


def _restored(meshes: Any, device: str) -> Surfaces:
    return Surfaces(meshes, device=launcher.device_or_default(device))


def _each(meshes: Any) -> list[TriangleMesh]:
    given: list[Any] = require_items(meshes, "meshes")
    if not len(given):
        raise InputError("meshes: there are none; give one or more")
    return [require_mesh(mesh, f"meshes[{number}]", images=False) for number, mesh in enumerate(given)]


def _unpacked(whole: TriangleMesh, offsets: Any) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """Checked packed arrays; a vertex that several meshes use is made one of each."""
    points, corners = whole.vertices, whole.faces
    begin = _read_offsets(offsets, None, len(corners), "meshes: offsets", "faces")
    owner = np.repeat(np.arange(len(begin) - 1), 3 * np.diff(begin))
    last = np.full(len(points), -1)
    last[corners.ravel()] = owner
    if not np.array_equal(last[corners.ravel()], owner):
        key, number = np.unique(corners.ravel() * np.int64(len(begin)) + owner, return_inverse=True)
        points, corners = points[key // len(begin)], number.reshape(-1, 3).astype(np.int32)
    return points, corners, begin


def _read_offsets(offsets: Any, parts: int | None, total: int, name: str, of: str) -> NDArray[np.int64]:
    found = np.asarray(user_arrays.read_numbers(offsets, name))
    with np.errstate(invalid="ignore"):
        begin = found.astype(np.int64) if found.ndim == 1 else np.zeros(0, np.int64)
    fits = len(begin) >= 2 if parts is None else len(begin) == parts + 1
    fits = fits and np.array_equal(begin, found) and begin[0] == 0 and begin[-1] == total
    if not fits or (np.diff(begin) < 0).any():
        many = "B + 1" if parts is None else str(parts + 1)
        raise InputError(f"{name}: {described(offsets)} is not {many} ascending whole numbers from 0 to {total} {of}")
    return begin


def _boxes(vertices: NDArray[np.float64], faces: NDArray[np.int32], begin: NDArray[np.int64]) -> NDArray[np.float64]:
    """The bounding box of each mesh, (B, 2, 3)."""
    bounds = np.empty((len(begin) - 1, 2, 3))
    corners, starts = faces.ravel(), 3 * begin[:-1]
    for axis in range(3):
        values = np.take(vertices[:, axis], corners)
        bounds[:, 0, axis] = np.minimum.reduceat(values, starts)
        bounds[:, 1, axis] = np.maximum.reduceat(values, starts)
    return bounds
