"""Closed solids around anything: bodies with holes, soups of triangles, sheets, points.

The isosurface at a distance from the input is closed whatever the input is. What it encloses goes, its faces are
merged, and what is left is held against the input: that surface is the answer, whichever way it was found.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.frame import Frame
from geokit.core.interop.types import Device, MeshLike
from geokit.core.interop.user_arrays import FROM_ZERO, require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh._simplify import with_attributes
from geokit.mesh.attributes.derived import used_vertices
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.hausdorff import DistanceSearch
from geokit.mesh.simplification.collapse import Past, collapsed
from geokit.mesh.simplification.proof import far_faces
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.audit import audit_topology, face_parts
from geokit.mesh.topology.connectivity import mesh_topology
from geokit.mesh.topology.orientation import enclosing_pairs
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.band.fields import THICKEST

# The isosurface lies this share of the tolerance away from the input, and voxels are as large as that share. A sheet
# is nearer to some voxels around each of its points than their half diagonal, 0.87, so none slips between them. The two
# differ, so that planes on the lattice do not put the isosurface on voxels.
LEVEL, VOXEL = 0.47, 0.5
# Where nothing can be proven, the same is tried nearer to it by the first, with voxels smaller by its square, so many
# times: what is left around a lone point when a gap has been closed may have slipped between voxels of the first size.
SMALLER, LATTICES = 0.85, 4
# Faces are merged within these shares of the level, each time from what the last one left and to no less than a part of
# it: so no face has many points to look at. The first time there is no limit but that part, which takes a third of the
# time, but is left out where it spoils more than this share of them. Where faces cross or are too far, those that they
# were stay as they are, so many times.
PASSES = ((np.inf, 8), (0.1, 12), (0.1, 12), (0.3, 12), (0.9, 12), (0.9, 12))
SPOILED = 0.01
TRIALS = 24
# Vertices this many times the distance from a face that is wrong stay; this many levels where there is no limit.
AROUND, UNLIMITED = 1.5, 0.15
# Lengths that are asked for, in sizes of the mesh: beyond, float32 does not see the mesh.
LARGEST = THICKEST / 4.0
# Roundings of coordinates that a tolerance has at least: with fewer, vertices of the isosurface fall on each other.
ROUNDINGS = 2.0**14
# Shares of the tolerance: the width of the bound of the deviation, and how far the isosurface is but at closed gaps.
BOUND_SHARE, NEAR = 0.02, 0.75


class Wrapped(NamedTuple):
    """A closed mesh around another one, with what is proven of it.

    Attributes:
        mesh: The wrap: closed, manifold, oriented, without self-intersections; faces outward.
        deviation: No point of the wrap is farther from the input, or from what it is grown to [world].
        bridges: Whether a corner of a face is farther from that than the tolerance (F,): there a gap was closed.
        component_count: Pieces of the wrap, with cavities where they are kept.
        genus: Handles of all pieces together.
        cavity_count: Pieces of surface inside of others that were left out.
    """

    mesh: TriangleMesh
    deviation: float
    bridges: NDArray[np.bool_]
    component_count: int
    genus: int
    cavity_count: int


@needs()
def wrap(
    mesh: MeshLike,
    *,
    tolerance: float,
    gap: float = 0.0,
    offset: float = 0.0,
    cavities: bool = False,
    device: Device = None,
) -> Wrapped:
    """A closed solid around anything: a body with holes, a soup of triangles, sheets, or points.

    The result is closed, manifold, oriented, and no two of its faces intersect but where they are neighbors (exact
    predicates). The whole input lies inside of it, and does not touch it. No point of it is farther from the input than
    ``tolerance``, or than ``tolerance + gap`` where a gap was closed. All of this is proven for the mesh that is
    returned, for all points of its faces; nothing is asked of the input.

    Everything grows by about half the tolerance. Edges are edges of the wrap again, within the tolerance, where faces
    of several tolerances meet (measured, not proven). Sheets become plates of about the tolerance. Holes and cracks in
    the walls of a body are closed if they are narrower than ``gap``, or than about a third of the tolerance. Between
    sheets that have both sides outside, only those narrower than about 1.3 times the square root of ``tolerance * gap``
    are. Through others the wrap goes inside, and covers what is there too: a body with a hole is closed from both sides
    of its wall. What cannot be reached from outside is left out, unless ``cavities`` are asked for.

    With an ``offset`` the wrap is that of the input grown by it, which holds all points no farther from it. Every point
    of the wrap is at least ``offset`` from the input, to 1e-12 of the size, and no farther than ``offset +
    tolerance``, or ``gap`` more where one was closed; ``deviation`` is that from the grown input. Holes narrower than
    twice the offset are closed by it. Attributes are those of :func:`geokit.mesh.transfer_attributes`.

    Time and memory go with the area over the square of the tolerance; with a hundredth of the size it takes seconds.
    Faces are merged on the CPU. More of them are left where sheets are nearer to each other than the tolerance.

    Args:
        mesh: Anything with faces. A face may be a point: rows (i, i, i) wrap a cloud.
        tolerance: Largest distance of the wrap from the input [world].
        gap: Largest width of holes to close in the walls of bodies [world]; beyond the diagonal it counts as that.
        offset: How far the input is grown first [world].
        cavities: Whether to keep the walls of cavities.
        device: Where distances are measured; None for the first GPU, else the CPU.
    Returns:
        Wrapped with mesh, deviation [world], bridges (F,), component_count, genus, cavity_count.
    Raises:
        InputError: mesh is no mesh or has no faces; tolerance is not a positive finite number, gap or offset is
            negative or not finite, cavities is no flag, there is no such device, the mesh is so far from the origin, or
            grown so far, that the tolerance is rounded away, or nothing could be proven within it.
        DeviceMemoryError: There is not enough memory for voxels of this size.
    Source:
        Lorensen and Cline (1987) for the isosurface; Garland and Heckbert (1997) for the collapse. The aim is that of
        Portaneri et al., "Alpha wrapping with an offset" (2022).
    Example:
        >>> bowl = gk.mesh.load("data/samples/shell.stl")
        >>> found = gk.mesh.wrap(bowl, tolerance=0.05)
        >>> gk.mesh.audit(found.mesh).watertight, found.deviation <= 0.05
        (True, True)
    """
    given = require_mesh(mesh, "mesh")
    tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    gap = require_finite_scalar(gap, "gap", low=FROM_ZERO)
    offset = require_finite_scalar(offset, "offset", low=FROM_ZERO)
    require_flag(cavities, "cavities")
    if not given.face_count:
        raise InputError(
            f"mesh: {given.name or 'it'} has no faces; there is nothing to wrap (of points, give faces (i, i, i))"
        )
    if (least := float(np.spacing(np.abs(given.bounds).max() + offset)) * ROUNDINGS) > tolerance:
        raise InputError(f"tolerance: {tolerance:g} is too small this far from 0; move the mesh, or give {least:g}")
    longest = float(np.ptp(given.bounds, axis=0).max())
    for name, length in (("tolerance", tolerance), ("offset", offset)):
        if length > LARGEST * longest > 0.0:
            raise InputError(
                f"{name}: {length:g} is over {LARGEST:g} sizes of the mesh, {longest:g}; give one in its unit"
            )
    # Lengths in a power of two near the tolerance, which rounds nothing: voxels of any size fit into float32.
    unit = int(np.frexp(tolerance)[1])
    gap = min(gap, float(np.hypot.reduce(np.ptp(given.bounds, axis=0))))
    tolerance, gap, offset = (float(np.ldexp(length, -unit)) for length in (tolerance, gap, offset))
    source = Surface((np.ldexp(given.vertices, -unit), given.faces), device=launcher.resolve_device(device))
    found: Wrapped | str = ""
    for lattice in range(LATTICES):
        level, voxel = LEVEL * tolerance * SMALLER**lattice, VOXEL * tolerance * SMALLER ** (2 * lattice)
        try:
            full, removed = _around(source, offset + level, voxel, gap, cavities)
        except DeviceMemoryError as error:
            told = f"voxels for {np.ldexp(tolerance, unit):g} need about {error.need >> 20} MiB, more than there is"
            raise DeviceMemoryError(f"tolerance: {told}; give a larger tolerance", need=error.need) from error
        for one in reversed([full, *_merged(full, source, offset, level, tolerance)]):
            found = _proven(one, source, offset, tolerance, gap)
            if isinstance(found, Wrapped):
                said: Any = {key: getattr(given, key) for key in ("name", "meters_per_unit", "up_axis")}
                made = TriangleMesh(np.ldexp(found.mesh.vertices, unit), found.mesh.faces, **said)
                made = with_attributes(made, given, device)
                return found._replace(mesh=made, deviation=float(np.ldexp(found.deviation, unit)), cavity_count=removed)
    raise InputError(
        f"tolerance: no wrap of {given.name or 'the mesh'} could be proven within it: {found}; give a larger tolerance"
    )


def _around(source: Surface, distance: float, voxel: float, gap: float, cavities: bool) -> tuple[TriangleMesh, int]:
    """The surface at a distance from the input without what it encloses, and the number of pieces left out."""
    from geokit.volume.distance_fields.from_mesh import from_mesh

    extract = partial(from_volume, method="marching_cubes", device=source.device)
    far = distance + 0.5 * gap
    made, removed = _outer(extract(from_mesh(source, voxel, thickness=2.0 * far, half_width=1.5)), cavities)
    if gap and made.face_count:
        # What is nearer than half a gap to the outside goes again; what was closed by then stays.
        width = (1.5, 0.5 * gap / voxel + 2.0)
        field = from_mesh(made, voxel, half_width=width, interior="keep", device=source.device)
        made, more = _outer(extract(field, isovalue=-0.5 * gap), cavities)
        removed += more
    return made, removed


def _outer(mesh: TriangleMesh, cavities: bool) -> tuple[TriangleMesh, int]:
    """The mesh without pieces inside of others, and their number."""
    if cavities:
        return mesh, 0
    _, first, label = np.unique(face_parts(mesh), return_index=True, return_inverse=True)
    label, held = label.reshape(-1), np.zeros(len(first), bool)
    # Pieces do not cross. So one face of each says whether it is inside of the one farthest out, as of many most are.
    outside = label[mesh.vertices[mesh.faces, 0].min(axis=1).argmin()]
    some = label == outside
    some[first] = True
    for whole in (False, True):
        rows = np.flatnonzero((some | whole) & ~held[label])
        piece, at = np.unique(label[rows], return_inverse=True)
        one = TriangleMesh(mesh.vertices, mesh.faces[rows])
        inner, outer = enclosing_pairs(one, at.reshape(-1), len(piece), partial(Surface, device="cpu"))
        held[piece[inner[whole | (piece[outer] == outside)]]] = True
    if not held.any():
        return mesh, 0
    used, faces = used_vertices(mesh.faces[~held[label]], mesh.vertex_count)
    return TriangleMesh(mesh.vertices[used], faces), int(held.sum())


def _merged(mesh: TriangleMesh, source: Surface, offset: float, level: float, tolerance: float) -> list[TriangleMesh]:
    """The mesh with ever fewer faces, as long as they neither cross each other nor the grown input, nor are too far."""
    made: list[TriangleMesh] = []
    full = Surface(mesh, device=source.device)
    for share, part in PASSES:
        fixed, past = np.zeros(mesh.vertex_count, bool), Past(mesh)
        around = level * (AROUND * share if share < np.inf else UNLIMITED)
        for _ in range(TRIALS):
            found = _collapsed(mesh, share * level, mesh.face_count // part, fixed, past)
            wrong = _wrong(found, source, offset)
            if not wrong.any():
                wrong = _far(found, full, source, offset, tolerance)
            if not wrong.any():
                made.append(found)
                mesh = found
                break
            there = Surface(TriangleMesh(found.vertices, found.faces[wrong]), device="cpu")
            distance = there.closest_point(mesh.vertices).distance
            if fixed.all() or (np.isinf(share) and wrong.mean() > SPOILED):
                break
            while fixed[distance <= around].all():  # the faces there are others than before, and wrong again
                around *= 2.0
            fixed |= distance <= around
    return made


def _collapsed(mesh: TriangleMesh, distance: float, count: int, fixed: NDArray[np.bool_], past: Past) -> TriangleMesh:
    """The mesh with edges collapsed within a distance, which is held at points only; what it can it repeats."""
    frame = Frame.around(*mesh.bounds)
    local = TriangleMesh((mesh.vertices - frame.origin) / frame.scale, mesh.faces)
    found, _ = collapsed(local, distance / frame.scale, count, fixed=fixed, past=past)
    return TriangleMesh(found.vertices * frame.scale + frame.origin, found.faces)


def _wrong(found: TriangleMesh, source: Surface, offset: float) -> NDArray[np.bool_]:
    """Whether each face crosses others or the grown input, or has some of the input next to it that lies outside."""
    surface = Surface(found, device=source.device)
    wrong = np.zeros(found.face_count, bool)
    wrong[surface.self_intersections()] = True
    if not offset:
        wrong[surface.intersecting_triangles(source)[:, 0]] = True
    elif (nearest := surface.distance(source)).distance < offset:
        # Besides the nearest face all that are seen to lack about as much.
        wrong[nearest.triangle_id] = True
        middle = source.closest_point(found.vertices[found.faces].mean(axis=1)).distance
        wrong |= middle < 2.0 * offset - nearest.distance
    if not wrong.any():
        points = source.mesh.vertices[used_vertices(source.mesh.faces, source.mesh.vertex_count)[0]]
        wrong[surface.closest_point(points[~surface.contains(points)]).triangle_id] = True
    return wrong


def _far(found: TriangleMesh, full: Surface, source: Surface, offset: float, tolerance: float) -> NDArray[np.bool_]:
    """Whether each face is too far from the input, though no gap is closed there: the full surface is near."""
    place = far_faces(found, source, offset + (1.0 - BOUND_SHARE) * tolerance, BOUND_SHARE * tolerance)
    far = ~np.isnan(place[:, 0])
    far[far] = source.closest_point(full.closest_point(place[far]).points).distance <= offset + NEAR * tolerance
    return far


def _proven(found: TriangleMesh, source: Surface, offset: float, tolerance: float, gap: float) -> Wrapped | str:
    """The wrap with what is proven of it, or what is wrong with it."""
    report = audit_topology(found, mesh_topology(found))
    if not (report.watertight and report.manifold and report.oriented) or report.coincident_count:
        return "it is not closed and manifold"
    # Without contact each part of the input is inside, as far as it is grown, if one of its points is.
    if _wrong(found, source, offset).any():
        return "it crosses itself or the input"
    search = DistanceSearch(source, BOUND_SHARE * tolerance, 0.0)
    search.run(found, *search.measure_vertices(found))
    # From points outside of what is grown, the way to it is that to the input without the offset.
    deviation = search.upper - offset
    if deviation > tolerance + gap:
        return f"it is {deviation / tolerance:g} tolerances away from the input"
    far = source.closest_point(found.vertices).distance > offset + tolerance
    genus = report.component_count - report.euler_number // 2
    return Wrapped(found, deviation, far[found.faces].any(axis=1), report.component_count, genus, 0)
