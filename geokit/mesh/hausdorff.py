"""How far two surfaces are from each other: the Hausdorff distance between proven bounds, mean and rms from samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit._arrays import require_finite_scalar
from geokit._host_array import HostArray
from geokit.errors import InputError
from geokit.mesh.model import TriangleMesh
from geokit.mesh.sample_surface import require_whole, sample_surface, scaled_areas
from geokit.mesh.surface import Surface

if TYPE_CHECKING:
    import warp as wp

__all__ = ["DirectedDistance", "HausdorffDistance", "hausdorff"]

# Enough for a standard error of about 0.3% of the mean where distances vary as much as they are large; a tenth of a
# second on a CPU.
SAMPLES = 100_000
# closest_point is good to 1e-12 of the diagonal: bounds cannot be told apart below a few times that, ...
LEAST_TOLERANCE = 4e-12
# ... nor below a few roundings of the coordinates, where triangles cannot be cut any more.
COORDINATE_ROUNDINGS = 32.0 * np.finfo(np.float64).eps
# Vertices come first, and samples and cuts lie on the surface only to some roundings of the coordinates: one that is
# farther by no more than that does not take a vertex's place. A mesh is 0 away from itself.
WITNESS_ROUNDINGS = 8.0 * np.finfo(np.float64).eps
# Pieces that are cut at once, about 60 MB with their halves.
BLOCK = 1 << 17
# While fewer pieces than this wait (152 bytes each), those with the largest bounds are cut first, which raises the
# lower bound soonest; from there on the newest, of which there can be no more than a block for each halving of an edge.
MOST_WAITING = 1 << 20
# Edges are cut where closest triangles change if their distances differ by this share of what is still allowed.
CUT_SHARE = 0.25


class DirectedDistance(NamedTuple):
    """Distances from the points of one surface to another surface, all [world].

    Attributes:
        max: The largest distance found, that of ``point``: a lower bound of the largest there is.
        upper: An upper bound of the largest there is.
        mean: Mean over the area, from samples.
        rms: Root of the mean squared distance over the area, from the same samples.
        mean_error: Standard error of ``mean``.
        rms_error: Standard error of ``rms``.
        point: The point of the first surface that is ``max`` away, shape (3,).
        closest_point: Its closest point on the other surface, shape (3,).
    """

    max: float
    upper: float
    mean: float
    rms: float
    mean_error: float
    rms_error: float
    point: NDArray[np.float64]
    closest_point: NDArray[np.float64]


class HausdorffDistance(NamedTuple):
    """Distances between two surfaces, all [world]; ``max``, ``upper``, ``mean`` and ``rms`` are the larger direction's.

    Attributes:
        max: The largest distance found, between ``point_a`` and ``point_b``: a lower bound of the Hausdorff distance.
        upper: An upper bound of the Hausdorff distance.
        mean: The larger mean.
        rms: The larger root mean square.
        point_a: On the first surface, shape (3,); one of the two is the closest point to the other on its surface.
        point_b: On the second surface, shape (3,).
        a_to_b: From the points of the first surface to the second surface.
        b_to_a: From the points of the second surface to the first surface.
    """

    max: float
    upper: float
    mean: float
    rms: float
    point_a: NDArray[np.float64]
    point_b: NDArray[np.float64]
    a_to_b: DirectedDistance
    b_to_a: DirectedDistance


def hausdorff(
    a: TriangleMesh | Surface,
    b: TriangleMesh | Surface,
    *,
    tolerance: float = 1e-4,
    samples: int = SAMPLES,
    seed: int = 0,
    device: Any = None,
) -> HausdorffDistance:
    """Hausdorff distance between two surfaces, with bounds; also its two directions, their means and points.

    The largest distance lies in ``[max, upper]``, and ``upper - max <= tolerance * diagonal``, the diagonal of the box
    around both meshes; each bound is good to 1e-12 of the diagonal (tests/property/test_hausdorff.py against dense
    samples, tests/unit/test_hausdorff.py for known shapes). Both hold for all points of the triangles, not for samples.
    A tolerance below 4e-12, or below some roundings of the coordinates, counts as that.

    Mean and rms come from samples that are uniform by area, and have the standard errors that are given with them; they
    are NaN for a mesh without area and for ``samples=0``.

    The time goes into regions where distances come near the largest one: two meshes that run close to each other
    everywhere take several times longer than others. Memory is bounded.

    Bounds keep the tolerance down to 1e-11 diagonals; asked for to 1e-7, they stay within 4e-6 diagonals up to 1e8
    diagonals from the origin. Held by tests/stability/test_envelopes.py.

    Args:
        a: The first surface; one that is prepared already is used as it is, on its own device.
        b: The second surface, likewise.
        tolerance: Largest width of ``[max, upper]``, as a share of the diagonal.
        samples: Points on each surface for mean and rms.
        seed: Seed of their random numbers, 0 or more.
        device: Where surfaces that are not prepared yet are: "cpu", "cuda:0", ...; None for the first GPU, else the
            CPU.
    Returns:
        HausdorffDistance with max, upper, mean, rms, point_a (3,), point_b (3,), a_to_b, b_to_a.
    Raises:
        InputError: a or b is neither a TriangleMesh nor a Surface, or has no faces; tolerance is not a positive finite
            number; samples or seed is negative or not a whole number; there is no such device.
        DeviceMemoryError: The device cannot hold the surfaces.
    Source:
        Guthe, Borodin, Klein, "Fast and accurate Hausdorff distance calculation between meshes" (2005); Cignoni,
        Rocchini, Scopigno, "Metro: measuring error on simplified surfaces" (1998) for mean and rms. Differs: triangles
        are cut where the closest triangle of the other surface changes, and bounded by convexity.
    Example:
        >>> low = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> high = gk.mesh.TriangleMesh([[0, 0, 2], [1, 0, 2], [0, 1, 2]], [[0, 1, 2]])
        >>> distance = gk.mesh.hausdorff(low, high, device="cpu")
        >>> distance.max, distance.upper, distance.a_to_b.point.tolist()
        (2.0, 2.0, [0.0, 0.0, 0.0])
    """
    tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    meshes = [_mesh_of(a, "a"), _mesh_of(b, "b")]
    samples = require_whole(samples, "samples")
    drawn = [_samples(mesh, samples, seed) for mesh in meshes]
    first = _surface_of(a, device)
    second = first if b is a else _surface_of(b, device)
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    diagonal = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    size = float(np.abs(corners).max())
    gap = max(tolerance * diagonal, LEAST_TOLERANCE * diagonal, COORDINATE_ROUNDINGS * size)
    a_to_b = _directed(meshes[0], drawn[0], second, gap, WITNESS_ROUNDINGS * size)
    b_to_a = _directed(meshes[1], drawn[1], first, gap, WITNESS_ROUNDINGS * size)
    ends = (a_to_b.point, a_to_b.closest_point)
    if b_to_a.max > a_to_b.max:
        ends = (b_to_a.closest_point, b_to_a.point)
    both = [a_to_b, b_to_a]
    # NaN where one of them is: there is no larger one then.
    mean, rms = (float(np.max([getattr(one, name) for one in both])) for name in ("mean", "rms"))
    largest, upper = max(one.max for one in both), max(one.upper for one in both)
    return HausdorffDistance(largest, upper, mean, rms, *ends, a_to_b, b_to_a)


def _mesh_of(given: Any, name: str) -> TriangleMesh:
    mesh = given.mesh if isinstance(given, Surface) else given
    if not isinstance(mesh, TriangleMesh):
        raise InputError(f"{name}: {type(given).__name__} is neither a TriangleMesh nor a Surface; make one of them")
    if len(mesh.faces) == 0:
        raise InputError(f"{name}: {mesh.name or 'the mesh'} has no faces; distances need at least one triangle")
    return mesh


def _surface_of(given: TriangleMesh | Surface, device: Any) -> Surface:
    return given if isinstance(given, Surface) else Surface(given, device=device)


def _samples(mesh: TriangleMesh, count: int, seed: int) -> NDArray[np.float64]:
    """Points on the mesh; none where it has no area."""
    has_area = count > 0 and bool(scaled_areas(mesh)[1].any())
    return sample_surface(mesh, count if has_area else 0, seed=seed).points


class _Pieces(NamedTuple):
    """Parts of triangles, P of them, and what is known of their distances."""

    corners: NDArray[np.float64]  # (P, 3, 3): piece, corner, axis [world]
    distance: NDArray[np.float64]  # (P, 3), of the corners
    triangle: NDArray[np.int32]  # (P, 3), the corners' closest triangles
    candidate: NDArray[np.int32]  # (P,), the triangle that gave the bound
    upper: NDArray[np.float64]  # (P,), bound of the distance anywhere in the piece
    depth: NDArray[np.int32]  # (P,), cuts that it came from
    edge: NDArray[np.int32]  # (P,), the edge to cut if that bound is too large; edge k starts at corner k
    cut: NDArray[np.float64]  # (P, 3), where [world]

    def take(self, rows: NDArray[Any]) -> _Pieces:
        return _Pieces(*(column[rows] for column in self))


class _Search:
    """Branch and bound for the largest distance of a mesh from a surface.

    Pieces whose bound does not exceed the largest distance found by more than the gap are done: all that is kept of
    them is the largest such bound.
    """

    def __init__(self, target: Surface, gap: float, rounding: float) -> None:
        from geokit.mesh._hausdorff_kernels import Target

        self.lower, self.done_upper = -math.inf, 0.0
        self.point = self.closest = np.full(3, math.nan)
        self._surface, self._gap, self._rounding = target, gap, rounding
        self._device: "wp.Device" = target._device
        self._target = Target()
        self._target.vertices, self._target.faces = target._vertices, target._faces

    def ask(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Distances of points of the mesh and their closest triangles; the largest distance is remembered."""
        found = self._surface.closest_point(points)
        if len(points):
            row = int(np.argmax(found.distance))
            if found.distance[row] > self.lower + self._rounding:
                self.lower = float(found.distance[row])
                self.point, self.closest = points[row].copy(), found.points[row].copy()
        return found.distance, found.triangle_id

    def ask_vertices(self, mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """As :meth:`ask`, for all vertices; NaN and -1 for those that no face uses."""
        used = np.zeros(len(mesh.vertices), bool)
        used[mesh.faces.ravel()] = True
        distance, triangle = np.full(len(used), math.nan), np.full(len(used), -1, np.int32)
        distance[used], triangle[used] = self.ask(mesh.vertices[used])
        return distance, triangle

    def run(self, mesh: TriangleMesh, distance: NDArray[np.float64], triangle: NDArray[np.int32]) -> None:
        """Close the gap between ``lower`` and ``upper`` over all triangles; takes what the vertices' answers are."""
        waiting: list[_Pieces] = []
        for start in range(0, len(mesh.faces), BLOCK):
            faces = mesh.faces[start : start + BLOCK]
            waiting.append(self._first_pieces(mesh.vertices[faces], distance[faces], triangle[faces]))
        pieces = _joined(waiting)
        while True:
            pieces = self._undecided(pieces)
            if len(pieces.upper) == 0:
                return
            chosen = self._next_rows(pieces)
            rest = np.ones(len(pieces.upper), bool)
            rest[chosen] = False
            pieces = _joined([pieces.take(rest), self._halves(pieces.take(chosen))])

    @property
    def upper(self) -> float:
        return max(self.lower, self.done_upper)

    def _first_pieces(
        self, corners: NDArray[np.float64], distance: NDArray[np.float64], triangle: NDArray[np.int32]
    ) -> _Pieces:
        """Whole triangles that are not decided by their corners, nor by the triangle closest to their middle."""
        count = len(corners)
        unknown = np.full(count, math.inf), np.zeros(count, np.int32), np.empty(count, np.int32), np.empty((count, 3))
        pieces = _Pieces(corners, distance, triangle, triangle[:, 0].copy(), *unknown)
        self._bound(pieces)
        pieces = self._undecided(pieces)
        pieces.candidate[:] = self.ask(pieces.corners.mean(axis=1))[1]
        self._bound(pieces)
        return self._undecided(pieces)

    def _undecided(self, pieces: _Pieces) -> _Pieces:
        undecided = pieces.upper > self.lower + self._gap
        self.done_upper = max(self.done_upper, float(np.max(pieces.upper[~undecided], initial=0.0)))
        return pieces if undecided.all() else pieces.take(undecided)

    def _next_rows(self, pieces: _Pieces) -> NDArray[np.int64]:
        count = len(pieces.upper)
        if count <= BLOCK or count > MOST_WAITING:
            return np.arange(max(0, count - BLOCK), count)
        return np.argpartition(pieces.upper, count - BLOCK)[count - BLOCK :]

    def _halves(self, pieces: _Pieces) -> _Pieces:
        """Each piece cut in two, bounded."""
        distance, triangle = self.ask(pieces.cut)
        both = _joined([pieces, pieces])
        rows = np.arange(len(both.upper))
        replaced = np.concatenate([pieces.edge, (pieces.edge + 1) % 3])
        both.corners[rows, replaced] = both.cut
        both.distance[rows, replaced] = np.tile(distance, 2)
        both.triangle[rows, replaced] = np.tile(triangle, 2)
        both.depth[:] += 1
        self._bound(both)
        return both

    def _bound(self, pieces: _Pieces) -> None:
        import warp as wp

        from geokit.mesh._hausdorff_kernels import bound_kernel

        flat = pieces.corners.reshape(-1, 3), pieces.distance.reshape(-1), pieces.triangle.reshape(-1), pieces.depth
        enough, least_gap = wp.float64(self.lower + self._gap), wp.float64(CUT_SHARE * self._gap)
        inputs = [*(self._sent(array) for array in flat), self._target, enough, least_gap]
        self._launch(bound_kernel, len(pieces.upper), inputs, [pieces.candidate, pieces.upper, pieces.edge, pieces.cut])

    def _sent(self, array: NDArray[Any]) -> Any:
        host = HostArray(np.ascontiguousarray(array))
        return host if self._device.is_cpu else host.warp.to(self._device)

    def _launch(self, kernel: Any, count: int, inputs: list[Any], results: list[NDArray[Any]]) -> None:
        """Run the kernel; ``results`` go in as they are and hold what it has made of them."""
        if count == 0:
            return
        outputs = [self._sent(array) for array in results]
        _launch.launch(kernel, count, inputs, outputs, self._device)
        for array, output in zip(results, outputs, strict=True):
            if not self._device.is_cpu:
                array[:] = output.numpy()


def _joined(parts: list[_Pieces]) -> _Pieces:
    return _Pieces(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _directed(
    mesh: TriangleMesh, samples: NDArray[np.float64], target: Surface, gap: float, rounding: float
) -> DirectedDistance:
    search = _Search(target, gap, rounding)
    vertices = search.ask_vertices(mesh)
    distance = search.ask(samples)[0]
    mean = rms = mean_error = rms_error = math.nan
    if len(samples):
        squared = distance * distance
        mean, rms = float(distance.mean()), math.sqrt(float(squared.mean()))
        root = math.sqrt(len(samples))
        mean_error = float(distance.std()) / root
        rms_error = float(squared.std()) / (2.0 * rms * root) if rms > 0.0 else 0.0
    search.run(mesh, *vertices)
    return DirectedDistance(search.lower, search.upper, mean, rms, mean_error, rms_error, search.point, search.closest)
