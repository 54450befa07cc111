"""Mesh simplification: as few triangles as a tolerance allows, or at most a given number."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from operator import attrgetter, eq, getitem, ne
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.blocks.chunked_queries import Progress
from geokit.core.interop.types import Device, MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_callable, require_count
from geokit.errors import InputError
from geokit.mesh.attributes.derived import with_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh

if TYPE_CHECKING:
    from geokit.mesh.simplification.collapse import Past
    from geokit.mesh.surfaces.surface import Surface

# Mapping into the unit frame and back rounds coordinates a few times.
FRAME_ROUNDINGS = 4.0 * float(np.finfo(np.float64).eps)
# Share of the tolerance that edges are collapsed within at first. The collapse looks at points only, so a place between
# them may be too far. Then the share is so much less there, and in the last trials everywhere.
SHARE = 0.92
LESS = 0.7
LOCAL = 10
# Such trials before the mesh is left as it is.
TRIALS = 16
# Width of the bounds of the deviation that is returned, as a share of the tolerance.
BOUND_SHARE = 0.02
# The same where only a number of faces is given, as a share of the mesh's size.
BOUND_SIZE = 1e-4
# Percent at the end of the search; then the result is measured.
LAST_PERCENT = 95
# Memory for each face, with its quadrics, its edges in a heap and both surfaces of the proof.
BYTES_PER_SIMPLIFIED = 1750
# Points on each surface for the percentile: fifty of them lie beyond it.
SAMPLES = 50_000
# Seed of these samples, unlike any that a user is likely to choose.
SEED = 20_260_601


class Simplified(NamedTuple):
    """A mesh with fewer faces, and its deviation from the original, which is measured when it is first read.

    Until then the result holds on to the original.

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


def _of_known(operation: Any) -> Any:
    return lambda self, *others, **named: operation(self.known, *others, **named)


class _Unmeasured(Simplified):
    """A result whose distances are measured when they are first read; in all else it is the result with them."""

    def __new__(cls, mesh: TriangleMesh, measure: Callable[[], tuple[float, float]]) -> _Unmeasured:
        found = tuple.__new__(cls, (mesh, math.nan, math.nan))
        found.__dict__["measure"] = measure
        return found

    @cached_property
    def known(self) -> Simplified:
        known = Simplified(self.mesh, *self.__dict__["measure"]())
        self.__dict__["measure"] = lambda: known[1:]  # lets go of the original; another thread may ask meanwhile
        return known

    deviation, deviation_p999 = map(property, map(_of_known, map(attrgetter, Simplified._fields[1:])))
    __iter__, __getitem__ = map(_of_known, (iter, getitem))
    __eq__, __ne__, __hash__, __repr__ = map(_of_known, (eq, ne, hash, repr))
    _replace, __reduce__ = _of_known(Simplified._replace), _of_known(lambda known: (Simplified, tuple(known)))


@needs(lambda mesh, **_: BYTES_PER_SIMPLIFIED * mesh.face_count, fatal=True)
def simplify(
    mesh: MeshLike,
    *,
    tolerance: float | None = None,
    face_count: int | None = None,
    device: Device = None,
    progress: Progress | None = None,
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

    The search ends where no edge can be collapsed any more; the result is not the minimum over all possible meshes. If
    nothing can be collapsed, the mesh is returned unchanged, with deviation 0. Faces may intersect where sheets are
    closer to each other than the tolerance.

    Vertices at equal positions are merged, unreferenced vertices are removed, and parts are not kept. Attributes come
    from the closest points of the original, on the same side of thin walls, as in
    :func:`geokit.mesh.transfer_attributes`; edges at seams of texture coordinates are collapsed like others, so a face
    may lie across one. Vertices that were not moved keep their coordinates to the bit. Vertices at edges of more than
    two faces, or where several fans of faces meet, stay. Results do not depend on the number of threads.

    Args:
        mesh: The mesh, with at least one face.
        tolerance: Largest distance between the surfaces [world].
        face_count: Largest number of faces.
        device: Where distances are measured: "cpu", "cuda:0", ...; None for the first GPU, else the CPU. Edges are
            collapsed on the threads of the CPU.
        progress: Called as ``progress(percent, 100)`` many times, with an estimate of the end.
    Returns:
        Simplified with mesh, deviation and deviation_p999 [world].
    Raises:
        InputError: mesh is not a TriangleMesh, or has no faces; not exactly one of tolerance and face_count is given;
            tolerance is not a positive finite number; face_count is not a whole number, or is too small to keep the
            topology (the message names the smallest count found); there is no such device.
        DeviceMemoryError: The device cannot hold the surfaces.
    Source:
        Garland and Heckbert, "Surface simplification using quadric error metrics" (1997). Differs: each collapse keeps
        the tolerance, the topology and the sides of the faces, and bounds of the Hausdorff distance prove the result.
    Example:
        >>> torus = gk.mesh.load("data/samples/torus.ply")
        >>> small = gk.mesh.simplify(torus, tolerance=0.01)
        >>> len(torus.faces) // len(small.mesh.faces) > 10, small.deviation <= 0.01
        (True, True)
    """
    mesh = require_mesh(mesh, "mesh")
    if (tolerance is None) == (face_count is None):
        given = "neither" if tolerance is None else "both"
        raise InputError(f"simplify: {given} given; give exactly one of tolerance and face_count")
    if tolerance is not None:
        tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    wanted = None if face_count is None else require_count(face_count, "face_count")
    if progress is not None:
        require_callable(progress, "progress")
    target = launcher.resolve_device(device)
    if len(mesh.faces) == 0:
        raise InputError(f"mesh: {mesh.name or 'it'} has no faces; there is nothing to simplify")
    if wanted is not None:
        found = _with_face_count(mesh, wanted, target)
        if progress:
            progress(100, 100)
    else:
        assert tolerance is not None
        found = within_tolerance(mesh, tolerance, target, progress)
    made = with_attributes(found.mesh, mesh, device)
    return found if made is found.mesh else _Unmeasured(made, lambda: found[1:])


def with_attributes(simple: TriangleMesh, mesh: TriangleMesh, device: Any) -> TriangleMesh:
    """A mesh that was made of another one with the attributes of that, as of :func:`transfer_attributes`."""
    from geokit.mesh._repair import merge_vertices
    from geokit.mesh._transfer import transfer_attributes

    if simple is mesh or not (mesh.vertex_data or mesh.face_data or mesh.corner_data or mesh.materials):
        return simple
    simple = with_data(simple, materials=mesh.materials)
    # The sides of a seam come to the corners where its vertices are one.
    return transfer_attributes(simple, merge_vertices(mesh), device=device)


def within_tolerance(mesh: TriangleMesh, tolerance: float, device: Any, progress: Progress | None = None) -> Simplified:
    """:func:`simplify` to a tolerance, with checked arguments."""
    original = _Original(mesh, device)
    original.progress = progress
    limit = (tolerance - original.rounding) / original.scale
    found = original.fewest(limit) if limit > 0.0 else None
    if progress:
        progress(100, 100)
    # Proven to be within the tolerance; the measured bound is sometimes slightly wider.
    return original.result(found, BOUND_SHARE * limit, tolerance) if found else Simplified(mesh, 0.0, 0.0)


def _with_face_count(mesh: TriangleMesh, wanted: int, device: Any) -> Simplified:
    if wanted >= len(mesh.faces):
        return Simplified(mesh, 0.0, 0.0)
    original = _Original(mesh, device)
    found, _ = original.collapsed(math.inf, wanted)
    if len(found.faces) <= wanted and original.is_kept_by(found):
        return original.result(found, BOUND_SIZE, math.inf)
    reachable = max(len(found.faces), wanted + 1)
    raise InputError(
        f"face_count: with {wanted} faces {mesh.name or 'the mesh'} would not hang together as it does; "
        f"ask for {reachable} or more"
    )


class _Original:
    """The original mesh at unit size, with everything that candidates are compared against."""

    progress: Progress | None = None

    def __init__(self, mesh: TriangleMesh, device: Any) -> None:
        from geokit.core.frame import Frame
        from geokit.mesh.simplification.invariants import shape_of
        from geokit.mesh.surfaces.surface import Surface

        self.said: Any = {key: getattr(mesh, key) for key in ("name", "meters_per_unit", "up_axis")}
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
        """The mesh with the fewest faces found within the limit; None if nothing could be collapsed."""
        from geokit.mesh.simplification.collapse import Past
        from geokit.mesh.simplification.proof import Proof
        from geokit.mesh.surfaces.surface import Surface

        faces = self.local.faces
        limits, proof = np.full(len(faces), SHARE * limit), Proof(self.surface, limit, self.shape.oriented)
        past = Past(self.local)
        for number in range(TRIALS):
            found, source = self.collapsed(limits, 0, number, past)
            if len(found.faces) == len(faces):
                return None
            wrong = proof.wrong(Surface(found, device=self.device), source)
            if not wrong.any():
                if self.keeps_shape(found):
                    return found
                wrong[:] = True
            # And around it.
            at = np.zeros(len(self.local.vertices), bool)
            at[faces[wrong]] = True
            limits[at[faces].any(axis=1) | (number >= LOCAL)] *= LESS
        return None

    def collapsed(
        self, limit: NDArray[np.float64] | float, face_count: int, number: int = 0, past: Past | None = None
    ) -> tuple[TriangleMesh, NDArray[np.int64]]:
        """The mesh with edges collapsed within the limit, and the face of the original that each face was."""
        from geokit.mesh.simplification.collapse import collapsed

        most = len(self.local.faces)

        def tell(left: int) -> None:
            if self.progress is not None:
                self.progress(int(LAST_PERCENT * (1.0 - 0.5**number * (0.5 + 0.5 * left / most))), 100)

        return collapsed(self.local, limit, face_count, past=past, tell=tell)

    def keeps_shape(self, found: TriangleMesh) -> bool:
        from geokit.mesh.simplification.invariants import shape_of

        return self.shape.is_kept_by(shape_of(found))

    def is_kept_by(self, found: TriangleMesh) -> bool:
        """Whether topology and sides of the faces are the original's, compared within the deviation."""
        from geokit.mesh.simplification.invariants import turned_faces

        # The deviation takes long, and matters only where no face alike is nearest or touches.
        return self.keeps_shape(found) and not (
            self.shape.oriented
            and len(turned_faces(found, self.surface, 0.0))
            and len(turned_faces(found, self.surface, self.bound(found, BOUND_SIZE)))
        )

    def bound(self, found: TriangleMesh | Surface, width: float) -> float:
        """An upper bound of the deviation of a mesh at unit size."""
        from geokit.mesh._hausdorff import hausdorff

        corners = np.concatenate([self.local.bounds, getattr(found, "mesh", found).bounds])
        diagonal = math.dist(corners.min(axis=0), corners.max(axis=0))
        return hausdorff(self.surface, found, tolerance=width / diagonal, samples=0, device=self.device).upper

    def result(self, found: TriangleMesh, width: float, most: float) -> Simplified:
        """The mesh in world coordinates; its deviation is measured within a width, and at most this [world]."""
        from geokit.mesh.surfaces.surface import Surface

        def measure() -> tuple[float, float]:
            surface = Surface(found, device=self.device)
            deviation = min(self.bound(surface, width) * self.scale + self.rounding, most)
            p999 = max(_percentile(self.local, surface), _percentile(found, self.surface))
            return deviation, min(p999 * self.scale + self.rounding, deviation)

        return _Unmeasured(TriangleMesh(self._restored(found.vertices), found.faces, **self.said), measure)

    def _restored(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions in the world; a point where a vertex was has the bits of that vertex."""
        # Adding zero turns -0.0 into 0.0, which is the same position in other bytes.
        rows = [np.ascontiguousarray(array) + 0.0 for array in (self.local.vertices, points)]
        keys, wanted = (array.view(np.dtype((np.void, 24))).reshape(-1) for array in rows)
        order = np.argsort(keys, kind="stable")
        nearest = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
        same = keys[nearest] == wanted
        return np.where(same[:, None], self.vertices[nearest], points * self.scale + self.origin)


def _one_vertex_a_position(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Used vertices, one for each position, and the faces whose three positions differ."""
    from geokit.mesh.topology.connectivity import collapsed_faces, position_corners

    corners, count = position_corners(mesh)
    first = np.empty(count, np.int64)
    first[corners.ravel()] = mesh.faces.ravel()
    corners, used = corners[~collapsed_faces(corners)], np.zeros(count, bool)
    used[corners] = True
    return mesh.vertices[first[used]], (np.cumsum(used, dtype=np.int32) - 1)[corners]


def _percentile(mesh: TriangleMesh, other: Any) -> float:
    """The 99.9th percentile of the distances from points on a mesh to another surface."""
    from geokit.mesh._sample_surface import sample_surface, scaled_areas

    if not scaled_areas(mesh)[1].any():
        return math.inf
    points = sample_surface(mesh, SAMPLES, seed=SEED).points
    return float(np.quantile(other.closest_point(points).distance, 0.999, method="higher"))
