"""Rigid registration of a cloud to another cloud, a surface or a distance field by ICP (iterative closest points)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.objects import has_faces
from geokit.core.interop.types import Device, Rows
from geokit.core.interop.user_arrays import LARGEST_MEASURED, read_vectors, require_finite_scalar
from geokit.core.memory.needs import needs, rows
from geokit.core.require import require_choice, require_count, require_table
from geokit.core.scan import gathered
from geokit.errors import InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import BYTES_PER_FACE, Surface
from geokit.points.clouds.rigid_fit import Step, orthonormal, plane_rank, plane_step, point_step
from geokit.points.search.nearest import nearest
from geokit.points.search.nearest_tree import build_tree
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

METHODS = ("point_to_plane", "point_to_point")
# Least number of pairs that determine a motion: a distance from a plane gives one of six equations, and three points
# determine a motion unless they are collinear.
LEAST_PAIRS = {"point_to_plane": 6, "point_to_point": 3}
# Tolerance on the orthonormality of a given start: six digits, as files store them.
ROTATION_TOLERANCE = 1e-5
# Steps halve errors or better; a pair that has not converged by then never will.
MOST_ITERATIONS = 10_000
# Steps shorter than this many roundings of the coordinates are rounding noise.
STEP_ROUNDINGS = 16.0 * np.finfo(np.float64).eps
# Runs of sums that are worth a thread; each run has 256 points.
RUN_GRAIN = 4
# Normals that are uncertain by so many times the median, squared, are at edges and tips: nothing there tells the rank.
MOST_TILT = 3.0
# Squares of the angles between equal normals: roundings of unit vectors leave 1e-15, files with six digits 1e-12.
# Without it a whole face whose normals round to another length would count as an edge.
EXACT_TILT = 1e-11
# A line is free to turn about itself, and to slide if its points are no samples of the same places.
SLIDING_LINE_RANK = 4
# Number of neighbors for estimating a target's normals if none are given.
NORMAL_NEIGHBORS = 16
# Within a voxel of the band's edge, interpolation reads the constant background beyond it.
BAND_MARGIN = 1.0
# Points whose partners are nearer than this share of the second nearest are samples of the same places.
SAME_PLACES = 0.1


class Registration(NamedTuple):
    """Result of a registration.

    Attributes:
        transform: Source to target, shape (4, 4) float64: ``target = transform[:3, :3] @ source + transform[:3, 3]``.
        rmse: Root mean squared distance between paired points under the transform [world].
        fitness: Share of the source points that have a partner, from 0 to 1.
        iterations: Number of steps taken.
        converged: Whether the last step moved no point by more than the tolerance.
        rank: Number of the six degrees of freedom that the shapes determine. Below 6 there are motions that change the
            distances by no more than the sampling does, as of a plane along itself.
    """

    transform: NDArray[np.float64]
    rmse: float
    fitness: float
    iterations: int
    converged: bool
    rank: int


class _Pose(NamedTuple):
    """The motion ``rotation @ (point - center) + place``, about a center near the source to keep digits far from the
    origin."""

    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    place: NDArray[np.float64]

    @property
    def matrix(self) -> NDArray[np.float64]:
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.place - self.rotation @ self.center
        return matrix

    def moved_by(self, step: Step) -> "_Pose":
        return _Pose(orthonormal(step.rotation @ self.rotation), self.center, self.place + step.shift)


def _bytes(source: Any, target: Any, *, target_normals: Any = None, **_: Any) -> float:
    if isinstance(target, TriangleMesh):
        return 360 * rows(source) + BYTES_PER_FACE * target.face_count
    if isinstance(target, SparseVolume):
        return 168 * rows(source)
    return 100 * rows(source) + (312 if target_normals is None else 72) * rows(target)


@of_constants
@needs(_bytes)
def register(
    source: Rows,
    target: Any,
    *,
    method: str = "point_to_plane",
    target_normals: Rows | None = None,
    initial: ArrayLike | None = None,
    max_distance: float = math.inf,
    max_iterations: int = 50,
    tolerance: float = 1e-9,
    device: Device = None,
) -> Registration:
    """Find the rigid motion that brings a cloud to a target, by iterative closest points.

    Each step pairs every moved point with its closest point on the target and applies the motion with the least sum of
    squared distances: "point_to_point" uses the distances between the points, "point_to_plane" those from the tangent
    planes of the target, which needs far fewer steps on smooth shapes. The method finds the nearest local minimum, not
    the global one; ``initial`` has to be about right. If the shapes overlap only in part, ``max_distance`` excludes
    points without a counterpart.

    The target is one of:

    - A cloud: the partner is the nearest point. The planes are those of ``target_normals``, or of ``normals(target)``
      over 16 neighbors if none are given.
    - A ``Surface`` (or a ``TriangleMesh``, from which one is made): the partner is the closest point, the plane that of
      its triangle.
    - A level set (``SparseVolume``): the partner lies along the gradient at the signed distance, both interpolated
      trilinearly. Points outside the band, or within a voxel of its edge, have no partner.

    Error: for noise-free data with matching points the pose is exact to about 1e-12 of the source's size, plus a few
    roundings of the coordinates. Sums are float64, about a center near the points, in a fixed order: the transform is
    the same for any number of threads.

    Motions that change no distance are not made: a plane does not slide along itself, a line does not rotate about
    itself.

    ``rank`` is the number of degrees of freedom that the shapes determine. Against a cloud, a motion counts if it
    changes the squared distances from the target's planes by more than three times what the uncertainty of the normals
    explains, which is estimated from the normals around each partner: their noise, and their change over the distance
    of the pair. Disjoint samples of a sphere have rank 3, of a plane 3, of an open cylinder 4, of a torus 5, of a line
    (by points) 4, for given and estimated normals and noise up to 0.3 spacings. Bodies of full rank keep it from about
    1,500 points on; below that, features of a few spacings may count as noise. If source and target are samples of the
    same places (pairs a tenth as far apart as neighbors), or the target is a mesh or level set, normals are exact, and
    all motions that change a distance count; with "point_to_point" those along the surface, too.

    Convergence: a noise-free ellipsoid (axes 1, 0.7, 0.45) is recovered exactly from starts rotated by up to 45
    degrees; from 90 degrees on some runs end at another pose, which rmse shows.

    Args:
        source: Positions [world], shape (N, 3), float32 or float64.
        target: Positions [world], shape (M, 3); a Surface or TriangleMesh; or a SparseVolume of class "level set".
        method: "point_to_plane" or "point_to_point".
        target_normals: Normals of a target cloud, shape (M, 3), of any length and sign; zeros where there is none.
        initial: Transform to start from, shape (4, 4), a rotation and a translation; None for the identity.
        max_distance: Pairs farther apart than this [world] are left out of a step.
        max_iterations: Largest number of steps, 1 or more.
        tolerance: Iteration stops after a step that moves no point by more than this share of the source's size (the
            root mean squared distance from its centroid).
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU. A Surface is queried on
            its own device.
    Returns:
        Registration with transform (4, 4), rmse [world], fitness, iterations, converged, rank.
    Raises:
        InputError: source, target or target_normals is not (N, 3), not finite or empty; target and target_normals have
            different lengths; the volume is not a level set; method is not known; initial is not a rigid transform;
            max_distance, tolerance or max_iterations is out of range; fewer pairs are within max_distance than a motion
            needs (6 for planes, 3 for points).
    Source:
        Besl, McKay, "A method for registration of 3-D shapes" (1992); Chen, Medioni, "Object modeling by registration
        of multiple range images" (1992); Kabsch, "A solution for the best rotation to relate two sets of vectors"
        (1976), with Umeyama's (1991) treatment of reflections. Differs: eigenvalues decide which motions are left out.
    Example:
        >>> corners = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1.0]])
        >>> found = gk.points.register(corners, corners + [0.1, 0, 0], method="point_to_point", device="cpu")
        >>> float(found.transform[0, 3].round(6)), found.rank, found.converged
        (0.1, 6, True)
    """
    require_choice(method, "method", METHODS)
    limit = require_finite_scalar(max_distance, "max_distance", low=0.0, infinite=True)
    tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    max_iterations = require_count(max_iterations, "max_iterations", 1, MOST_ITERATIONS)
    start = _require_rigid(initial)
    goal = _make_target(target, target_normals, method == "point_to_plane", device)
    points = read_vectors(source, "source", goal.device, largest=LARGEST_MEASURED).array
    if len(points) == 0:
        raise InputError("source: it has no points; give at least one")
    center, size, radius = _measure(points)
    # Along a space-filling curve, consecutive points have partners that are close in memory.
    order = launcher.morton_order(points, center - radius, 2.0 * radius, points.device)
    points = gathered(points, order, len(points))
    pose = _Pose(start[:3, :3], center, start[:3, :3] @ center + start[:3, 3])
    search = _Search(points, goal, method, limit, size)
    converged, steps = False, 0
    while not converged and steps < max_iterations:
        step = search.step(pose)
        pose, steps = pose.moved_by(step), steps + 1
        # Upper bound on the motion of a point on the source's bounding sphere.
        moved = float(np.linalg.norm(step.rotation - np.eye(3), 2)) * radius + float(np.linalg.norm(step.shift))
        rounding = STEP_ROUNDINGS * float(np.abs([pose.center, pose.place]).max() + radius)
        converged = bool(moved <= tolerance * size + rounding)
    sums = search.sums(pose)
    rank = search.rank(pose, sums)
    rmse, fitness = math.sqrt(sums[1] / sums[0]), float(sums[0]) / len(points)
    return Registration(pose.matrix, rmse, fitness, steps, converged, rank)


class _Search:
    """Pairs and steps of one registration."""

    def __init__(self, points: "wp.array", target: Target, method: str, limit: float, size: float) -> None:
        self._points, self._target, self._method = points, target, method
        self._limit, self._size = limit, size
        self._moved: Any = None
        self._pairs: Any = None

    def step(self, pose: _Pose) -> Step:
        return self.solve(self.sums(pose))

    def solve(self, sums: NDArray[np.float64]) -> Step:
        return plane_step(sums, self._size) if self._method == "point_to_plane" else point_step(sums)

    def rank(self, pose: _Pose, sums: NDArray[np.float64]) -> int:
        """Number of determined motions, from the sums of the last pairs."""
        from geokit.points.clouds.register_kernels import tangents_kernel

        rank = self.solve(sums).rank
        found = self._target.tilts(self._moved, self._pairs) if rank > 3 else None
        if found is None:
            return rank
        if rank == 5 and self._method == "point_to_point":
            return SLIDING_LINE_RANK
        pairs, tilt = found
        paired = pairs.paired.numpy() == 1
        most = max(MOST_TILT * float(np.median(tilt.numpy()[paired])), EXACT_TILT)
        device, count = self._target.device, len(self._moved)
        sides = [wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2)]
        kept = wp.empty(count, dtype=wp.int32, device=device)
        given = [pairs.normal, pairs.paired, tilt, wp.float64(most)]
        launcher.launch(tangents_kernel, count, given, [*sides, kept], device)
        planes, *noise = (
            self._summed(self._moved, Pairs(pairs.partner, along, kept), wp.vec3d(*pose.place), "point_to_plane")
            for along in (pairs.normal, *sides)
        )
        return plane_rank(planes, noise[0] + noise[1])

    def sums(self, pose: _Pose) -> NDArray[np.float64]:
        """Sums over the pairs of the source in a pose."""
        from geokit.points.clouds.register_kernels import move_kernel

        device = self._target.device
        moved = wp.empty(len(self._points), dtype=wp.vec3d, device=device)
        given = [wp.mat33d(*pose.rotation.ravel().tolist()), wp.vec3d(*pose.center), wp.vec3d(*pose.place)]
        launcher.launch(move_kernel, len(moved), [self._points, *given], [moved], device)
        self._moved, self._pairs = moved, self._target.pairs(moved, self._limit)
        sums = self._summed(moved, self._pairs, given[2], self._method)
        least = LEAST_PAIRS[self._method]
        if sums[0] < least:
            raise InputError(
                f"max_distance: {int(sums[0])} of the source's {len(moved)} points have a partner within "
                f"{self._limit:g}, and {self._method} needs {least}; raise it, start nearer with initial=, or widen "
                "the band of a volume"
            )
        return sums

    def _summed(self, moved: "wp.array", pairs: Pairs, center: Any, method: str) -> NDArray[np.float64]:
        from geokit.points.clouds import register_kernels as kernels

        device = self._target.device
        runs = -(-len(moved) // int(kernels.SUM_RUN))
        if method == "point_to_plane":
            kernel, width = kernels.plane_sums_kernel, int(kernels.PLANE_SUMS)
            inputs = [moved, *pairs, center, wp.float64(1.0 / self._size)]
        else:
            kernel, width = kernels.point_sums_kernel, int(kernels.POINT_SUMS)
            inputs = [moved, pairs.partner, pairs.paired, center]
        sums = wp.empty((runs, width), dtype=wp.float64, device=device)
        launcher.launch(kernel, runs, inputs, [sums], device, grain=RUN_GRAIN)
        return sums.numpy().sum(axis=0)


def _measure(points: "wp.array") -> tuple[NDArray[np.float64], float, float]:
    """Centroid [world], root mean squared and largest distance from it [world]; 1.0 for a cloud without extent."""
    table: NDArray[np.float64] = points.numpy()
    center = table[0] + (table - table[0]).mean(axis=0)
    away = np.linalg.norm(table - center, axis=1)
    radius = float(away.max())
    if radius == 0.0:
        return center, 1.0, 0.0
    return center, radius * float(np.sqrt(np.mean((away / radius) ** 2))), radius


def _require_rigid(initial: Any) -> NDArray[np.float64]:
    if initial is None:
        return np.eye(4)
    matrix = require_table(initial, "initial", (4, 4))
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0 or (matrix[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError(
            "initial: it is not a rotation and a translation (last row 0 0 0 1, columns orthonormal and right-handed, "
            f"off by {off:.3g}); take scale and reflection out of it"
        )
    rigid = matrix.copy()
    rigid[:3, :3] = orthonormal(rotation)
    return rigid


class Pairs(NamedTuple):
    """Partner, its normal, and a flag (1 or 0) for each moved point; entries without a partner are not set."""

    partner: "wp.array"
    normal: "wp.array"
    paired: "wp.array"


class Target(ABC):
    """A registration target.

    Attributes:
        device: Device on which the target is queried.
    """

    def __init__(self, device: "wp.Device") -> None:
        self.device = device
        self._room: Pairs | None = None

    @abstractmethod
    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        """Partners within the distance for moved points, vec3d (N,) [world]; the next call overwrites them."""

    def tilts(self, moved: "wp.array", pairs: Pairs) -> tuple[Pairs, "wp.array"] | None:
        """The last pairs with normals, and the squared uncertainty of each normal [rad^2], float64 (N,).

        None if the normals are exact at the moved points: a surface's, or a cloud's with samples of the same places.
        """
        return None

    def room(self, count: int) -> Pairs:
        """Arrays for so many pairs, reused by every step."""
        if self._room is None or len(self._room.paired) != count:
            self._room = Pairs(
                wp.empty(count, dtype=wp.vec3d, device=self.device),
                wp.empty(count, dtype=wp.vec3d, device=self.device),
                wp.empty(count, dtype=wp.int32, device=self.device),
            )
        return self._room


def _make_target(target: Any, target_normals: Any, wants_normals: bool, device: Any) -> Target:
    """The Target for a ``target`` argument.

    Raises:
        InputError: The argument is not a valid target, or the normals do not fit it.
    """
    if isinstance(target, TriangleMesh) or has_faces(target, "target"):
        target = Surface(require_mesh(target, "target", images=False), device=device)
    if isinstance(target, (Surface, SparseVolume)):
        if target_normals is not None:
            kind = type(target).__name__
            raise InputError(f"target_normals: a {kind} has its own; give them with a cloud only")
        return _SurfaceTarget(snapshot(target)) if isinstance(target, Surface) else _VolumeTarget(target, device)
    return _CloudTarget(target, target_normals, wants_normals, launcher.resolve_device(device))


class _CloudTarget(Target):
    def __init__(self, points: Any, normals: Any, wants_normals: bool, device: "wp.Device") -> None:
        super().__init__(device)
        self._points = read_vectors(points, "target", device, largest=LARGEST_MEASURED).array
        if len(self._points) == 0:
            raise InputError("target: it has no points; give at least one")
        self._normals = wp.empty(0, dtype=wp.vec3d, device=device)
        if normals is not None:
            self._normals = read_vectors(normals, "target_normals", device).array
            if len(self._normals) != len(self._points):
                raise InputError(
                    f"target_normals: {len(self._normals)} rows for {len(self._points)} points; give one for each"
                )
            self._normals = _unit(self._normals)
        elif wants_normals:
            self._estimate_normals()
        self._wants_normals = wants_normals
        self._tree = build_tree(self._points)
        self._partner: Any = None

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        from geokit.points.clouds.register_kernels import limit_kernel, partner_kernel

        limit: Any = max_distance * max_distance
        if self._partner is not None:
            # The search radius is the distance to the previous partner: most searches end where they begin.
            given = [moved, self._points, self._partner, wp.float64(limit)]
            limit = wp.empty(len(moved), dtype=wp.float64, device=self.device)
            launcher.launch(limit_kernel, len(moved), given, [limit], self.device)
        _, indices = nearest(self._tree, 1, moved, limit_squared=limit)
        self._partner = indices.flatten()
        room = self.room(len(moved))
        inputs = [self._partner, self._points, self._normals, False]
        launcher.launch(partner_kernel, len(moved), inputs, [*room], self.device)
        return room

    def tilts(self, moved: "wp.array", pairs: Pairs) -> tuple[Pairs, "wp.array"] | None:
        from geokit.points.clouds import register_kernels as kernels

        if len(self._points) < int(kernels.AROUND):
            return None
        distance, around = nearest(self._tree, int(kernels.AROUND), moved)
        near = distance.numpy()[:, :2]
        if np.median(near[:, 0] - SAME_PLACES * near[:, 1]) <= 0.0:
            return None
        if not self._wants_normals:
            if not len(self._normals):
                self._estimate_normals()
            inputs = [self._partner, self._points, self._normals, False]
            launcher.launch(kernels.partner_kernel, len(moved), inputs, [*pairs], self.device)
        tilt = wp.empty(len(moved), dtype=wp.float64, device=self.device)
        inputs = [moved, self._points, self._normals, around]
        launcher.launch(kernels.tilt_kernel, len(moved), inputs, [tilt], self.device)
        return pairs, tilt

    def _estimate_normals(self) -> None:
        from geokit.points._normals import normals

        # Signs do not affect distances from planes.
        self._normals = normals(self._points, k=NORMAL_NEIGHBORS, orientation="none", device=self.device).normals


class _SurfaceTarget(Target):
    def __init__(self, surface: "Surface") -> None:
        super().__init__(launcher.resolve_device(surface.device))
        self._surface = surface
        corners = surface.mesh.vertices[surface.mesh.faces]
        # Scale to unit size before multiplying, so that products of very long or short edges stay in the float64 range.
        edges = (corners[:, 1:] - corners[:, :1]) / surface.scale
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # A triangle without area has no plane; a zero normal takes no part.
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
        self._normals = wp.array(normals, dtype=wp.vec3d, device=self.device)

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        from geokit.points.clouds.register_kernels import partner_kernel

        found = self._surface.closest_point(moved, max_distance=max_distance)
        room = self.room(len(moved))
        inputs = [found.triangle_id, found.points, self._normals, True]
        launcher.launch(partner_kernel, len(moved), inputs, [*room], self.device)
        return room


class _VolumeTarget(Target):
    def __init__(self, volume: "SparseVolume", device: Any) -> None:
        from geokit.volume.at_points.sample import is_scalar

        info = volume.info
        if info.grid_class != "level set" or not is_scalar(volume):
            raise InputError(
                f"target: grid {info.name!r} is a {info.grid_class} of type {info.grid_type}, not a signed distance; "
                "give a level set, as geokit.volume.from_mesh makes it"
            )
        super().__init__(launcher.resolve_device(device))
        self._volume = volume
        self._reach = abs(float(info.background)) - BAND_MARGIN * float(np.max(info.voxel_size))

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        from geokit.points.clouds.register_kernels import volume_partner_kernel

        distance = self._volume.sample(moved, device=self.device)
        gradient = self._volume.gradient(moved, device=self.device)
        room = self.room(len(moved))
        inputs = [moved, distance, gradient, wp.float64(min(max_distance, self._reach))]
        launcher.launch(volume_partner_kernel, len(moved), inputs, [*room], self.device)
        return room


def _unit(normals: "wp.array") -> "wp.array":
    from geokit.points.clouds.register_kernels import unit_kernel

    unit = wp.empty(len(normals), dtype=wp.vec3d, device=normals.device)
    launcher.launch(unit_kernel, len(normals), [normals], [unit], normals.device)
    return unit
