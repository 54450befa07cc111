"""What rays hit on a prepared surface: first hits, all hits, occlusion."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.blocks.chunked_queries import Progress, in_chunks
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Rows
from geokit.core.launches.late_checks import later
from geokit.core.memory.pinned import host_flags
from geokit.core.memory.unchecked import allocating
from geokit.core.query.ask import query
from geokit.core.scan import row_offsets
from geokit.errors import InputError
from geokit.mesh.topology.size_limits import require_measurable

if TYPE_CHECKING:
    import warp as wp
    from numpy.typing import ArrayLike

    from geokit.core.frame import Frame
    from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["RayHitLists", "RayHits", "RayQueries", "checked_limits", "group_size", "wide_slots"]

# Rays per thread on a CPU, where many are in flight at once. In small groups, finished rays find no successors; with
# large ones, threads wait for the last group. On a GPU each ray has its own thread.
FEWEST_IN_GROUP = 256
MOST_IN_GROUP = 1024
GROUPS_PER_THREAD = 8
# From this many rays on, two launches on a GPU are faster than one.
FEWEST_IN_PASSES = 1 << 14

NAMES = ("origins", "directions")
# Fewest rays for each of several GPUs: of fewer, first hits take less time than their copies to another one.
LEAST_RAYS_ON_GPUS = 1 << 22
# Triangles that any hits test before the tree, at most, and the share of the area that they need to hold together.
MOST_WIDE = 32
WIDE_SHARE = 0.15
# Only triangles with this share of the area count.
LEAST_SHARE = 1.0 / 256.0

# A kernel, its number of items, and its inputs.
_Launch = tuple[Any, int, list[Any]]


class RayHits(NamedTuple):
    """The first hit of each ray. A miss has triangle_id -1, t inf, and NaN elsewhere.

    Attributes:
        t: Where the rays hit, in units of their directions, shape (N,).
        triangle_id: Triangles that they hit, shape (N,) int32.
        barycentric: Weights of the triangles' corners there, shape (N, 3).
    """

    t: Array
    triangle_id: Array
    barycentric: Array


class RayHitLists(NamedTuple):
    """All hits of each ray.

    Attributes:
        offsets: Ray i has rows ``offsets[i]`` to ``offsets[i + 1]`` of the others, by ascending t; shape (N + 1,).
        t: Where the rays hit, in units of their directions, shape (H,).
        triangle_id: Triangles that they hit, shape (H,) int32.
        barycentric: Weights of the triangles' corners there, shape (H, 3).
    """

    offsets: Array
    t: Array
    triangle_id: Array
    barycentric: Array


class RayQueries:
    """Ray queries of a :class:`geokit.mesh.Surface`."""

    mesh: TriangleMesh
    _device: "wp.Device"
    _frame: Frame
    _frames: Any
    _tree: Any

    @query(
        "origins",
        "directions",
        gradient=".gradients:RAYCAST",
        is_replayed=True,
        least_rows=LEAST_RAYS_ON_GPUS,
        row_bytes=52,
    )
    def raycast(
        self,
        origins: Rows,
        directions: Rows,
        *,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> RayHits:
        """First hit of each ray.

        Watertight: no ray passes between triangles through an edge or a vertex that they share. Ties go to the lowest
        triangle_id.

        Hits are within 1e-6 of the mesh's size up to 1e9 sizes from the origin, for rays that start up to 1e8 sizes
        away. Rays that start 1e12 sizes away or farther may miss. The error of t is 1e-15 of the mesh's size over the
        sine of the angle between ray and face, also on slivers. For rays that start on the surface, a t_min of 1e-13 of
        the mesh's size skips the face of the start.

        Args:
            origins: Starts of the rays [world], shape (N, 3).
            directions: Directions of any length [world], shape (N, 3), or one of shape (3,) for all.
            t_min: Hits with a smaller t are ignored, in units of the direction; for rays that start on the surface.
            max_distance: Length of the rays [world]; farther hits are misses.
            transform: A rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...): where it
                is. All is in world coordinates; moving rounds by 1e-15 of the size. None leaves the surface in place.
            progress: Called as ``progress(done, total)`` after each block of a few million rays.
        Returns:
            RayHits with t (N,) in units of the direction, triangle_id (N,), barycentric (N, 3). A miss has triangle_id
            -1, t inf, and NaN elsewhere.
        Raises:
            InputError: An array is not (N, 3) or not finite, their lengths differ, a direction is zero, t_min is
                negative or not finite, max_distance is negative or not a number, the transform is not rigid (to 1e-6)
                or is given beside tensors with gradients, or the mesh is smaller than 1e-70 or larger than 1e70.
        Source:
            Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection" (JCGT 2013). Differs: float64 throughout.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.raycast([[0.25, 0.25, 2.0]], [[0, 0, -1]]).t
            array([2.])
        """
        import warp as wp

        from geokit.mesh.queries.raycast_kernels import raycast_kernel

        require_measurable(self.mesh, self._frame)

        def query(rays: user_arrays.Batch, heading: user_arrays.Batch) -> RayHits:
            found = user_arrays.empty_outputs(len(rays), [wp.float64, wp.int32, wp.vec3d], rays.rows)
            finish = self._begin(raycast_kernel, rays, heading, t_min, max_distance, found)
            if not rays.is_shared:
                finish()
            # Of shared rays a GPU is at work meanwhile.
            answer = RayHits(*map(rays.to_caller, found))
            if rays.is_shared:
                later(finish, self._device)
            return answer

        return self._in_chunks(query, origins, directions, progress)

    @query("origins", "directions", least_rows=LEAST_RAYS_ON_GPUS, row_bytes=52)
    def raycast_all(
        self,
        origins: Rows,
        directions: Rows,
        *,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
    ) -> RayHitLists:
        """All crossings of each ray with the surface, by ascending t.

        A passage through an edge or a vertex is one crossing, of one of the triangles there, however exactly the ray is
        aimed at it. Touching an edge or a vertex from one side counts zero or two times, as if the ray were displaced
        by an infinitesimal. A line always crosses a closed surface an even number of times. Rays within a triangle's
        plane do not cross it.

        t is exact to the error bound of :meth:`raycast`. But ``t_min`` and ``max_distance`` are compared with the
        unrefined t of a sliver, which loses as many digits as its longest edge exceeds its height: 4e-4 of the edge at
        an aspect ratio of 1e12 (docs/design/exact-queries.md).

        Args:
            origins: Starts of the rays [world], shape (N, 3).
            directions: Directions of any length [world], shape (N, 3), or one of shape (3,) for all.
            t_min: Crossings with a smaller t are ignored, in units of the direction.
            max_distance: Length of the rays [world].
            transform: As for :meth:`raycast`.
        Returns:
            RayHitLists with offsets (N + 1,), t (H,) in units of the direction, triangle_id (H,), barycentric (H, 3).
        Raises:
            InputError: An array is not (N, 3) or not finite, their lengths differ, a direction is zero, t_min is
                negative or not finite, max_distance is negative or not a number, the transform is not rigid (to 1e-6),
                or the mesh is smaller than 1e-70 or larger than 1e70.
        Source:
            Edelsbrunner, Mücke, "Simulation of Simplicity" (1990), for rays through edges and vertices.
        """
        import warp as wp

        from geokit.mesh.queries.crossings_kernels import list_crossings_kernel

        rays, heading = user_arrays.read_rows([origins, directions], NAMES, self._device, defer=True)
        count = self._count_crossings(rays, heading, t_min, max_distance)
        offsets = row_offsets(count)
        total = int(offsets[-1:].numpy()[0])
        outputs = [user_arrays.empty(total, kind, rays.rows) for kind in (wp.float64, wp.int32, wp.vec3d)]
        self._begin(list_crossings_kernel, rays, heading, t_min, max_distance, outputs, offsets)()
        give = rays.to_lists or rays.to_caller
        return RayHitLists(give(offsets), *map(give, outputs))

    @query("origins", "directions", is_replayed=True, is_stepped=True, least_rows=LEAST_RAYS_ON_GPUS, row_bytes=16)
    def crossing_count(
        self,
        origins: Rows,
        directions: Rows,
        *,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Array:
        """Number of crossings of each ray with the surface: the lengths of the lists of :meth:`raycast_all`.

        Args:
            origins, directions, t_min, max_distance, transform, progress: As for :meth:`raycast`.
        Returns:
            int (N,).
        Raises:
            InputError: The same conditions as for :meth:`raycast`.
        """

        def query(rays: user_arrays.Batch, heading: user_arrays.Batch) -> Any:
            return rays.to_caller(self._count_crossings(rays, heading, t_min, max_distance))

        return self._in_chunks(query, origins, directions, progress)

    @query("origins", "directions", is_replayed=True, is_stepped=True, least_rows=LEAST_RAYS_ON_GPUS, row_bytes=13)
    def occluded(
        self,
        origins: Rows,
        directions: Rows,
        *,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Array:
        """True for rays that hit the surface; faster than :meth:`raycast`, because any hit ends the search.

        The answer always agrees with :meth:`raycast`.

        Args:
            origins, directions, t_min, max_distance, transform, progress: As for :meth:`raycast`.
        Returns:
            bool (N,).
        Raises:
            InputError: The same conditions as for :meth:`raycast`.
        """
        import warp as wp

        from geokit.mesh.queries.raycast_kernels import occluded_kernel

        def query(rays: user_arrays.Batch, heading: user_arrays.Batch) -> Any:
            occluded = user_arrays.empty(len(rays), wp.bool, rays.rows)
            self._begin(occluded_kernel, rays, heading, t_min, max_distance, [occluded], tree=self._any_hit_tree)()
            return rays.to_caller(occluded)

        return self._in_chunks(query, origins, directions, progress)

    @cached_property
    def _ray_tree(self) -> Any:
        """The tree with leaves for rays; on a CPU these are built at the first ray.

        A separate handle: two threads may build the leaves at the same time, and each needs its own until its rays end.
        """
        if not self._device.is_cpu:
            return self._tree
        from geokit.mesh.bvh.bvh8 import ray_leaves
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        tree: Any = SurfaceTree()
        tree.assign(self._tree)
        slots = np.array([0, len(tree.slot_triangle)])
        tree.ray_leaves = ray_leaves(tree.slot_triangle, slots, (tree.corners, tree.leaves), *self._frames)
        return tree

    @cached_property
    def _any_hit_tree(self) -> Any:
        """The same with the slots of the widest triangles, which any hits test first."""
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        tree: Any = SurfaceTree()
        tree.assign(self._ray_tree)
        tree.wide = wide_slots(tree.corners)
        return tree

    def _count_crossings(
        self, rays: user_arrays.Batch, directions: user_arrays.Batch, t_min: float, max_distance: float
    ) -> "wp.array":
        import warp as wp

        from geokit.mesh.queries.crossings_kernels import count_crossings_kernel

        count = user_arrays.empty(len(rays), wp.int32, rays.rows)
        self._begin(count_crossings_kernel, rays, directions, t_min, max_distance, [count])()
        return count

    def _in_chunks(self, query: Any, origins: Any, directions: Any, progress: Progress | None) -> Any:
        return in_chunks(query, [origins, directions], NAMES, self._device, progress, defer=True)

    def _begin(
        self,
        kernel: Any,
        rays: user_arrays.Batch,
        heading: user_arrays.Batch,
        t_min: float,
        max_distance: float,
        outputs: list[Any],
        *streams: "wp.array",
        tree: Any = None,
    ) -> Callable[[], None]:
        """Launch the kernel; the function that is returned waits for it and casts what it left undecided."""
        from geokit.mesh.bvh.ray_walk_kernels import SHORTEST_DIRECTION

        start, reach = checked_limits(rays, heading, t_min, max_distance)
        bad = host_flags(2, self._device)  # [0]: a ray is invalid; [1]: some rays are undecided
        count = len(rays)
        shared = [rays.rows, heading.rows, *streams, tree or self._ray_tree, start, reach]
        group = group_size(count) if self._device.is_cpu else 1
        whole = kernel, -(-count // group), [group, *shared]
        in_passes = self._device.is_cuda and count >= FEWEST_IN_PASSES
        first, again = self._passes(whole, count, shared) if in_passes else (whole, None)
        launcher.launch(*first, [*outputs, bad], self._device, grain=1)

        def finish() -> None:
            if again is not None and bad.is_raised(1):
                launcher.launch(*again, [*outputs, bad], self._device)
            # Waits for the launches, so that the answer is whole.
            user_arrays.refuse_rays(bad, rays, heading, SHORTEST_DIRECTION)

        return finish

    def _passes(self, whole: _Launch, count: int, shared: list[Any]) -> tuple[_Launch, _Launch | None]:
        """The launch that is faster than the whole one, and the one for what it leaves undecided."""
        from geokit.mesh.queries import raycast_kernels

        if whole[0] is raycast_kernels.raycast_kernel:
            from geokit.mesh.bvh.ray_walk_kernels import first_hit_kernel

            return (first_hit_kernel, count, shared), (raycast_kernels.raycast_undecided_kernel, count, shared)
        if whole[0] is raycast_kernels.occluded_kernel:
            from geokit.mesh.bvh.ray_walk_kernels import any_hit_kernel

            return (any_hit_kernel, count, shared), (raycast_kernels.occluded_left_over_kernel, count, shared)
        return whole, None


def checked_limits(
    rays: user_arrays.Batch, heading: user_arrays.Batch, t_min: float, max_distance: float
) -> tuple[Any, Any]:
    """``t_min`` and ``max_distance`` as kernels take them; there must be a direction for each origin."""
    if len(rays) != len(heading):
        raise InputError(f"directions: {len(heading)} rows for {len(rays)} origins; give one direction for each")
    return user_arrays.ray_limits(t_min, max_distance)


def group_size(count: int) -> int:
    """Rays per thread on a CPU."""
    size = count // (GROUPS_PER_THREAD * launcher.thread_count())
    return min(max(size, FEWEST_IN_GROUP), MOST_IN_GROUP)


def wide_slots(corners: "wp.array") -> "wp.array":
    """Slots of the few triangles that hold much of the area, the widest first, int32; none where there are no such.

    Args:
        corners: World corners of the triangle in each slot, three per slot.
    """
    import warp as wp

    from geokit.mesh.bvh import tree_kernels as kernels

    device, slots = corners.device, len(corners) // 3
    area = wp.empty(slots, dtype=wp.float64, device=device)
    launcher.launch(kernels.area_kernel, slots, [corners], [area], device)
    with allocating(device, slots):
        whole = float(wp.utils.array_sum(area))
    # No more than these have so much of the area, up to rounding.
    found = [wp.empty(int(1.0 / LEAST_SHARE) + 1, dtype=kind, device=device) for kind in (wp.int32, wp.float64)]
    count = wp.zeros(1, dtype=wp.int32, device=device)
    outputs = [count, *found]
    launcher.launch(kernels.list_wide_kernel, slots, [area, wp.float64(LEAST_SHARE * whole)], outputs, device)
    some, areas = (array.numpy()[: int(count.numpy()[0]) if whole > 0.0 else 0] for array in found)
    widest = np.lexsort((some, -areas))[:MOST_WIDE]
    chosen = some[widest] if areas[widest].sum() >= WIDE_SHARE * whole else some[:0]
    return wp.array(chosen, dtype=wp.int32, device=device)
