"""Mesh simplification: as few triangles as a tolerance allows, or at most a given number."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.mesh._model import TriangleMesh
from geokit.mesh._sample_surface import require_whole

__all__ = ["Simplified", "simplify"]

# Mapping into the unit frame and back rounds coordinates a few times.
FRAME_ROUNDINGS = 4.0 * float(np.finfo(np.float64).eps)
# The search over face counts ends at this ratio. A smaller one costs more trials, and counts change by more than that
# when a mesh is rotated.
COUNT_RATIO = 1.02
# Ratio of the first round, whose trials start with the most faces and take longest; the next round makes up for it.
FIRST_RATIO = 1.2
# Before the search, meshes with this fraction of the faces are tried as starting points: trials take as long as the
# start has faces. A start must have its vertices within this share of the tolerance. A larger share costs faces.
STEP = 4
STEP_SHARE = 0.1
# Collapsing the result again, with new quadrics, continues where the previous round reached its worst place: up to a
# third fewer faces. Rounds end when one gains less than this share.
ROUND_GAIN = 0.03
# Width of the bounds of the deviation that is returned, as a share of the tolerance.
BOUND_SHARE = 0.02
# The same where only a number of faces is given, as a share of the mesh's size.
BOUND_SIZE = 1e-4
# Points on each surface for the percentile: fifty of them lie beyond it.
SAMPLES = 50_000
# Seed of these samples, unlike any that a user is likely to choose.
SEED = 20_260_601


class Simplified(NamedTuple):
    """A mesh with fewer faces, and its deviation from the original.

    Attributes:
        mesh: The simplified mesh.
        deviation: Upper bound of the Hausdorff distance between both surfaces [world]: no point of either surface is
            farther from the other. 0 if the mesh is unchanged.
        deviation_p999: Distance [world] within which 99.9% of the area of each surface lies from the other, measured on
            random points.
    """

    mesh: TriangleMesh
    deviation: float
    deviation_p999: float


def simplify(
    mesh: TriangleMesh, *, tolerance: float | None = None, face_count: int | None = None, device: Any = None
) -> Simplified:
    """Simplify a mesh: as few faces as found within a tolerance, or at most a given number of faces.

    Exactly one of ``tolerance`` and ``face_count`` is given. Edges are collapsed in the order of their quadric error. A
    result is accepted only if

    - no point of either surface is farther than the tolerance from the other one: ``deviation`` is an upper bound of
      the Hausdorff distance, proven for all points of the triangles as in :func:`geokit.mesh.hausdorff`, and at most
      the tolerance;
    - the topology is unchanged: watertight, manifold and oriented where the mesh was, with as many components, boundary
      loops and handles, and no more faces without area;
    - no face is flipped: for each face there is a face of the original within the tolerance with a similar normal (only
      checked where the original is oriented).

    The search over the number of faces ends within 2%; the result is not the minimum over all possible meshes. If
    nothing can be collapsed, the mesh is returned unchanged, with deviation 0. Faces may intersect where sheets are
    closer to each other than the tolerance.

    Vertices at equal positions are merged, unreferenced vertices are removed, and parts are not kept. Vertices that
    were not moved keep their coordinates to the bit. Others are exact to 5e-7 of the mesh's size, which the deviation
    includes. Results do not depend on the number of threads.

    Args:
        mesh: The mesh, with at least one face.
        tolerance: Largest distance between the surfaces [world].
        face_count: Largest number of faces.
        device: Where distances are measured: "cpu", "cuda:0", ...; None for the first GPU, else the CPU. Collapsing
            runs on one CPU thread.
    Returns:
        Simplified with mesh, deviation and deviation_p999 [world].
    Raises:
        InputError: mesh is not a TriangleMesh, or has no faces; not exactly one of tolerance and face_count is given;
            tolerance is not a positive finite number; face_count is not a whole number, or is too small to keep the
            topology (the message names the smallest count found); there is no such device.
        DeviceMemoryError: The device cannot hold the surfaces.
    Source:
        Garland and Heckbert, "Surface simplification using quadric error metrics" (1997), by VTK. Differs: the result
        is checked, and bounds of the Hausdorff distance choose the number of faces.
    Example:
        >>> torus = gk.mesh.load("data/samples/torus.ply")
        >>> small = gk.mesh.simplify(torus, tolerance=0.01)
        >>> len(torus.faces) // len(small.mesh.faces) > 10, small.deviation <= 0.01
        (True, True)

    Held by: tests/mesh/simplification/test_simplify.py, tests/house/test_tolerances_property.py
    """
    if not isinstance(mesh, TriangleMesh):
        raise InputError(f"mesh: {type(mesh).__name__} is not a TriangleMesh; make one from vertices and faces")
    if (tolerance is None) == (face_count is None):
        given = "neither" if tolerance is None else "both"
        raise InputError(f"simplify: {given} given; give exactly one of tolerance and face_count")
    if tolerance is not None:
        tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    wanted = None if face_count is None else require_whole(face_count, "face_count")
    target = launcher.resolve_device(device)
    if len(mesh.faces) == 0:
        raise InputError(f"mesh: {mesh.name or 'it'} has no faces; there is nothing to simplify")
    if wanted is not None:
        return _with_face_count(mesh, wanted, target)
    assert tolerance is not None
    return within_tolerance(mesh, tolerance, target)


def within_tolerance(mesh: TriangleMesh, tolerance: float, device: Any) -> Simplified:
    """:func:`simplify` to a tolerance, with checked arguments."""
    original = _Original(mesh, device)
    limit = (tolerance - original.rounding) / original.scale
    found = original.fewest(limit) if limit > 0.0 else None
    if found is None:
        return Simplified(mesh, 0.0, 0.0)
    simple, bound = original.measured(found, BOUND_SHARE * limit)
    # Already proven to be within the limit; the measured bound is sometimes slightly wider.
    return simple._replace(deviation=min(bound, tolerance), deviation_p999=min(simple.deviation_p999, tolerance))


def _with_face_count(mesh: TriangleMesh, wanted: int, device: Any) -> Simplified:
    if wanted >= len(mesh.faces):
        return Simplified(mesh, 0.0, 0.0)
    original = _Original(mesh, device)
    found = original.collapsed(original.local, wanted)
    if found is not None and len(found.faces) <= wanted:
        simple, _ = original.measured(found, BOUND_SIZE)
        if original.keeps_facing(found, simple.deviation / original.scale):
            return simple
    fewest = original.fewest(math.inf)
    reachable = len(mesh.faces) if fewest is None else len(fewest.faces)
    raise InputError(
        f"face_count: with {wanted} faces {mesh.name or 'the mesh'} would not hang together as it does; "
        f"ask for {reachable} or more"
    )


class _Original:
    """The original mesh at unit size, with everything that candidates are compared against."""

    def __init__(self, mesh: TriangleMesh, device: Any) -> None:
        from geokit.core.frame import Frame
        from geokit.mesh._surface import Surface
        from geokit.mesh.simplification.invariants import shape_of

        self.name = mesh.name
        self.vertices, faces = _one_vertex_a_position(mesh)
        lower, upper = mesh.bounds
        around = Frame.around(lower, upper)
        self.origin = around.origin
        # A power of two, so that scaling does not round: twice the half of the longest side, rounded up.
        self.scale = math.ldexp(1.0, min(math.frexp(around.scale)[1] + 1, 1023))
        self.rounding = FRAME_ROUNDINGS * float(max(np.abs(lower).max(), np.abs(upper).max()))
        self.local = TriangleMesh((self.vertices - self.origin) / self.scale, faces, name=mesh.name)
        self.device = device
        self.shape = shape_of(self.local)
        self.surface = Surface(self.local, device=device)

    def fewest(self, limit: float) -> TriangleMesh | None:
        """The mesh with the fewest faces found within the limit, at unit size; None if nothing could be collapsed."""
        best, ratio = self._descended(limit), FIRST_RATIO
        while True:
            found = self._bisected(best, limit, ratio)
            gain = 0.0 if found is None else 1.0 - len(found.faces) / len(best.faces)
            best = best if found is None else found
            if ratio == COUNT_RATIO and gain < ROUND_GAIN:
                return None if best is self.local else best
            ratio = COUNT_RATIO

    def _descended(self, limit: float) -> TriangleMesh:
        """A mesh well within the limit with fewer faces than the original, so that trials on it are faster."""
        start = self.local
        while True:
            found = self.collapsed(start, len(start.faces) // STEP)
            if found is None or not self._has_vertices_within_limit(found, STEP_SHARE * limit):
                return start
            start = found

    def _has_vertices_within_limit(self, found: TriangleMesh, limit: float) -> bool:
        from geokit.mesh._surface import Surface

        there = self.surface.closest_point(found.vertices).distance.max()
        back = Surface(found, device=self.device).closest_point(self.local.vertices).distance.max()
        return bool(max(there, back) <= limit)

    def _bisected(self, start: TriangleMesh, limit: float, ratio: float) -> TriangleMesh | None:
        best: TriangleMesh | None = None
        # One face is always too few. `low` is a count that failed, `high` the smallest that was accepted.
        low, high = 1, len(start.faces)
        while high > low * ratio and high > low + 1:
            count = min(max(round(math.sqrt(low * high)), low + 1), high - 1)
            found = self.collapsed(start, count)
            if found is not None and len(found.faces) < high and self.has_within(found, limit):
                best, high = found, len(found.faces)
                low = min(low, high)
            else:
                low = count
        return best

    def collapsed(self, start: TriangleMesh, face_count: int) -> TriangleMesh | None:
        """The mesh collapsed to that many faces, or None if its topology differs from the original's."""
        from geokit.mesh.simplification.invariants import shape_of
        from geokit.mesh.simplification.quadric import decimate

        found = decimate(start, face_count)
        if len(found.faces) == 0 or not self.shape.is_kept_by(shape_of(found)):
            return None
        return found

    def has_within(self, found: TriangleMesh, limit: float) -> bool:
        from geokit.mesh._surface import Surface
        from geokit.mesh.simplification.deviation import within

        if math.isinf(limit):
            return True
        return within(self.surface, Surface(found, device=self.device), limit) and self.keeps_facing(found, limit)

    def keeps_facing(self, found: TriangleMesh, distance: float) -> bool:
        from geokit.mesh.simplification.invariants import has_similar_normals

        return not self.shape.oriented or has_similar_normals(found, self.surface, distance)

    def measured(self, found: TriangleMesh, width: float) -> tuple[Simplified, float]:
        """The mesh in world coordinates with its deviation, and the deviation before it is clamped to the tolerance."""
        from geokit.mesh._hausdorff import hausdorff
        from geokit.mesh._surface import Surface
        from geokit.mesh.simplification.quadric import restored

        surface = Surface(found, device=self.device)
        corners = np.concatenate([self.local.bounds, found.bounds])
        diagonal = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
        bound = hausdorff(self.surface, surface, tolerance=width / diagonal, samples=0).upper
        p999 = max(_percentile(self.local, surface), _percentile(found, self.surface))
        vertices = restored(found.vertices, self.local.vertices, self.vertices, self._to_world)
        mesh = TriangleMesh(vertices, found.faces, name=self.name)
        deviation = bound * self.scale + self.rounding
        return Simplified(mesh, deviation, min(p999 * self.scale + self.rounding, deviation)), deviation

    def _to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        return local * self.scale + self.origin


def _one_vertex_a_position(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Used vertices, one for each position, and the faces whose three positions differ."""
    from geokit.mesh.topology.connectivity import collapsed_faces, position_corners

    corners, count = position_corners(mesh)
    first = np.empty(count, np.int64)
    first[corners.ravel()] = mesh.faces.ravel()
    used, at = np.unique(corners[~collapsed_faces(corners)], return_inverse=True)
    return mesh.vertices[first[used]], at.reshape(-1, 3).astype(np.int32)


def _percentile(mesh: TriangleMesh, other: Any) -> float:
    """The 99.9th percentile of the distances from points on a mesh to another surface."""
    from geokit.mesh._sample_surface import sample_surface, scaled_areas

    if not scaled_areas(mesh)[1].any():
        return math.inf
    points = sample_surface(mesh, SAMPLES, seed=SEED).points
    return float(np.quantile(other.closest_point(points).distance, 0.999, method="higher"))
