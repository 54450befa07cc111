"""Narrow-band distance fields of triangle meshes; only tiles near the surface are visited."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from geokit.core.blocks.chunked_queries import Progress
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Device, MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_callable, require_choice, require_flag, require_text
from geokit.errors import InputError
from geokit.mesh._sample_surface import total_area
from geokit.volume.band.band import BandShape, build_band, build_triangle_ids, make_band
from geokit.volume.band.fields import (
    _origin,
    band_metadata,
    grid_head,
    half_widths,
    in_float32,
    mesh_metadata,
    resolve_surface,
    source_of,
    volume_from_built,
)
from geokit.volume.band.tiles import TILE_VOXELS, Lattice
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.tolerance.band_memory import band_start
from geokit.volume.tree.grid_head import checked_head

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface

METHODS = ("geokit", "openvdb")
DEFAULT_HALF_WIDTH = 3.0
# Memory for each leaf of a band, with its distances, tiles and nodes; OpenVDB keeps more, and so do nearest triangles.
BYTES_PER_LEAF, BYTES_PER_OPENVDB_LEAF, BYTES_PER_TRIANGLES_LEAF = 4900, 9000, 10700
# Memory for each face, for the tree and the signs.
BYTES_PER_SIGNED_FACE = 280


class MeshBand(NamedTuple):
    """Result of :func:`from_mesh_with_triangles`: a field, and the triangle nearest to each of its voxels.

    Attributes:
        distance: The field, as from :func:`from_mesh`.
        triangle_id: int32 grid with the same active voxels: row of the nearest face, -1 elsewhere.
    """

    distance: SparseVolume
    triangle_id: SparseVolume


def _from_mesh_bytes(
    mesh: TriangleMesh | Surface,
    voxel_size: float | None = None,
    *,
    half_width: float | tuple[float, float] | None = None,
    method: str = "geokit",
    **_: Any,
) -> float:
    """Of the surface, and of the leaves that a band covers, by the area.

    Where a body crosses itself, mesh/solids/trimming.py checks what it needs more: nobody knows before how many
    pieces there are. That is up to as much again.
    """
    if voxel_size is None:
        return 0.0
    leaf = BYTES_PER_OPENVDB_LEAF if method == "openvdb" else BYTES_PER_LEAF
    return _band_bytes(mesh, voxel_size, DEFAULT_HALF_WIDTH if half_width is None else half_width, leaf)


def _from_mesh_with_triangles_bytes(
    mesh: TriangleMesh | Surface, voxel_size: float, *, half_width: Any = DEFAULT_HALF_WIDTH, **_: Any
) -> float:
    return _band_bytes(mesh, voxel_size, half_width, BYTES_PER_TRIANGLES_LEAF)


def _band_bytes(mesh: TriangleMesh | Surface, voxel_size: float, half_width: Any, leaf_bytes: int) -> float:
    both = 2.0 * half_width if isinstance(half_width, (int, float)) else float(sum(half_width))
    # A Surface has its tree already.
    given: Any = getattr(mesh, "mesh", None)
    made = BYTES_PER_SIGNED_FACE * mesh.face_count if given is None else 0  # type: ignore[union-attr]
    scale, area = total_area(mesh if given is None else given)  # type: ignore[arg-type]
    # A plane crosses one and a half tiles for each of its own area on average over all directions.
    leaves = area / (8.0 * voxel_size * scale) ** 2 * (1.5 + both / 8.0)
    return made + leaves * leaf_bytes


@of_constants
@needs(_from_mesh_bytes, late=True)
def from_mesh(
    mesh: MeshLike | Surface,
    voxel_size: float | None = None,
    *,
    tolerance: float | None = None,
    within: float | None = None,
    order: int | None = None,
    half_width: float | tuple[float, float] | None = None,
    sign: str = "auto",
    thickness: float | None = None,
    interior: str = "remove",
    method: str = "geokit",
    codec: str | None = None,
    compact: bool = False,
    name: str | None = None,
    device: Device = None,
    progress: Progress | None = None,
) -> SparseVolume:
    """Build a signed distance field of a mesh, negative inside, as a NanoVDB level set on the voxels near its surface.

    Distances at active voxels are those of ``Surface.closest_point``, rounded to float32: exact for the nearest float64
    triangle. A voxel is active if it is nearer to the surface than the width of the band. Elsewhere the value is the
    exterior width outside (the background) and minus the interior width inside. The result has the same bytes for any
    number of threads; on CUDA it is within two roundings of the CPU's.

    Signs are those of ``Surface.signed_distance``, of active and of inactive voxels; voxels on a closed surface
    itself, to 1e-12 of the band's width, are outside. Closed meshes evaluate a few
    voxels and derive the others from their distances; open ones evaluate every active voxel, and the ends of each run
    of inactive ones. Up to 2e-5 of the voxels around an open mesh may differ: inactive ones beside the sign change.

    Of an open mesh the field is open too, and a UserWarning says so with ``sign`` "auto": ``mesh.from_volume`` of it
    has holes where the band ends. A ``half_width`` of half the widest hole or more closes them.

    In the hole of an open mesh the sign changes away from the surface, where the winding number passes 1/2, and the
    field jumps. The leaves that this change crosses are part of the grid; they have no active voxels. ``from_volume``
    shows the change as far as the band reaches: to one voxel more than the half width from the mesh (2.5% of the
    vertices of a bowl at 80 voxels across are farther than 1.5 voxels from it). Outside of the band's box, widened by
    its longest edge on each side, all is outside. With another ``sign`` than "winding" the box is not widened.

    Several closed bodies mean their union. Where they touch, overlap or lie within each other, surface that has the
    solid on both sides is no boundary and leaves the field, and so do open sheets inside of a body; cavities stay. The
    union is exact (manifold3d). Bodies that touch but for rounding, up to 1e-6 of the mesh's size apart, grow by as
    much as joins them, at most 1e-6 of the size. Where a body lies inside of itself by more than 0.1% of its surface,
    or the union cannot be made, faces that cross others are cut into pieces instead; next to where they cross,
    distances are then right to a quarter of a voxel, or of the tolerance. Metadata "geokit:interior" says "removed". If
    the mesh is open as well, or too crumpled (4 million pieces), that surface stays and a UserWarning says why.
    ``interior="keep"`` keeps all, as does a ``sign`` that allows no such union: "parity", "pseudonormal" or "none".

    Faces that lie back to back count once on closed components (``Surface.signed_distance`` has the rules). Open sheets
    of two sides have no inside: a UserWarning says so, and ``thickness`` makes solids of them.

    Voxel centers lie at whole multiples of ``voxel_size``. The transform has a translation (of whole voxels) only where
    indices would otherwise exceed 2^20, with ``compact``, and with ``tolerance``: then index 0 is the beginning of the
    band. So a small body has one upper node, 270 kB; around the origin of indices it has eight.

    ``tolerance`` replaces ``voxel_size``: the voxel size, and each of half width, order and codec that is not given,
    are those of least memory with which ``sample`` is within the tolerance of the exact distance wherever it is
    checked. It is checked at 120,000 points no farther than ``within`` from the surface and at some 80,000 more around
    the worst of them; none of these is used to choose. ``info.order`` is the chosen order, which ``sample`` and
    ``gradient`` use by default. ``info.achieved_error`` is the largest error that the check found,
    ``info.achieved_error_999`` its 99.9th percentile. Ray casts and isosurfaces use the trilinear interpolant: pass
    ``order=1`` if those must keep the tolerance. :func:`geokit.volume.plan` lists the choices. In the property tests
    the tolerance also holds at points other than the checked ones on all meshes; on those that are searched
    exhaustively the memory is within 1.5 times of the least.

    ``info.metadata`` records the source of the field: "geokit:source" (the mesh's name), "geokit:source_sha256" (of its
    vertices and faces), "geokit:voxel_size", "geokit:version", "geokit:sign_method" and "geokit:sign_reason".
    "geokit:lost_components" lists the connected components of the mesh, numbered in the order of their first faces,
    that are too thin to hold a single negative voxel; a UserWarning reports them too. Unit and up axis of
    the mesh, where it says them, are in ``info.meters_per_unit`` and ``info.up_axis``; operations, ``.vdb``, ``.nvdb``
    and :func:`geokit.mesh.from_volume` keep them.

    Sampled at order 1, points inside walls of 2 voxels and more are inside. Around the middle of any wall the
    interpolated distance is up to half a voxel off, and walls thinner than a voxel may have no inside. Up to 1e9 sizes
    from the origin distances are right to 1e-6 of the size.

    Args:
        mesh: Triangles, or a Surface of them, whose tree (and device) is then used.
        voxel_size: Edge length of a voxel [world]; give either this or ``tolerance``.
        tolerance: Largest error of the interpolated distance [world].
        within: Distance from the surface up to which the tolerance holds [world]. None for the tolerance itself, or a
            quarter of it if the mesh is open: beside an open border the sign jumps, and so does the field, by twice the
            distance.
        order: With ``tolerance``: the order of interpolation that will be used, 1, 2 or 3; None for the best.
        half_width: Width of the band on either side of the surface [voxels], at least 1 (None for 3, or with
            ``tolerance`` as little as interpolation needs); or a pair of widths, outside and inside.
        sign: Method that tells inside from outside, as for ``Surface.signed_distance``; "auto" takes that of
            ``Surface.sign_method``. "none" gives unsigned distances in a grid of class "unknown".
        thickness: Thickness [world] of a solid shell around the surface, whose level set the field then is: the
            unsigned distance less half the thickness; at most a million times the mesh's size. ``sign`` is then
            ignored.
        interior: What happens to surface that has the solid on both sides, between bodies that touch or overlap, and to
            bodies and sheets within others: "remove" (it is no boundary), or "keep".
        method: "geokit", or "openvdb" for OpenVDB's field of a closed mesh, for comparison: it is up to half a voxel
            off.
        codec: Storage of the values, as in :func:`geokit.volume.quantize`; None for float32, with ``tolerance`` for the
            best.
        compact: Whether index 0 is the beginning of the band, for as few nodes as possible. Otherwise fields of one
            voxel size have one transform, and unions of them need no resampling.
        name: Name of the grid; None for the mesh's name.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU. On a GPU the
            grid stays there until ``nanovdb`` is read.
        progress: Called as ``progress(percent, 100)`` during the search for a tolerance, with an estimate of its end.
    Returns:
        SparseVolume of type "float" and class "level set".
    Raises:
        InputError: An argument is out of range, options exclude each other, the mesh has no faces, the voxels are too
            small to be numbered, or the tolerance cannot be kept; the message names one that can.
        DeviceMemoryError: The band does not fit into memory, or exceeds the 2^33 bytes that it can have; the message
            says which voxel size or tolerance would fit.
        MissingDependencyError: ``method`` is "openvdb" and geokit was built without OpenVDB.
    Source:
        Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology" (2013), for the structure. Differs:
        distances are exact at every active voxel. Unions: Manifold, by Lalish et al.
    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> mesh = gk.mesh.TriangleMesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> sdf = gk.volume.from_mesh(mesh, 0.125, device="cpu")
        >>> sdf.sample([[0.25, 0.25, 0.125]], device="cpu")
        array([-0.125])
        >>> fine = gk.volume.from_mesh(mesh, tolerance=1e-3, device="cpu")
        >>> fine.info.achieved_error <= 1e-3
        True
    """
    require_choice(method, "method", METHODS)
    require_flag(compact, "compact")
    if name is not None:
        require_text(name, "name")
    if progress is not None:
        require_callable(progress, "progress")
    if (voxel_size is None) == (tolerance is None):
        raise InputError(
            f"voxel_size: {'nothing' if tolerance is None else 'tolerance as well'} given; give either voxel_size or "
            "tolerance"
        )
    if tolerance is not None:
        asked: dict[str, Any] = {
            "within": within,
            "order": order,
            "half_width": half_width,
            "thickness": thickness,
            "codec": codec,
        }
        from geokit.volume.tolerance.from_mesh import within_tolerance

        asked |= {"interior": interior, "device": device}
        return within_tolerance(mesh, tolerance, asked, sign, method, name, progress)
    assert voxel_size is not None
    for option, value in (("within", within), ("order", order)):
        if value is not None:
            raise InputError(f"{option}: only of use with tolerance; leave it out")
    half_width = DEFAULT_HALF_WIDTH if half_width is None else half_width
    if codec is not None:
        from geokit.volume.retyped.quantize import CODECS

        require_choice(codec, "codec", CODECS)
    if compact and method == "openvdb":
        raise InputError("compact: only of use with method='geokit'; leave it out")
    surface, shape, lattice = _prepared(mesh, voxel_size, half_width, sign, thickness, interior, device, compact)
    head = grid_head(shape, lattice, surface.mesh.name if name is None else name)
    if method == "openvdb":
        volume = _by_openvdb(surface, lattice, shape, surface.mesh.name if name is None else name)
    else:
        band = make_band(lattice, shape)
        volume = volume_from_built(build_band(band, head), band_metadata(band, sign))
    if codec is None:
        return volume
    from geokit.volume.retyped.quantize import quantize

    return quantize(volume, codec)


@of_constants
@needs(_from_mesh_with_triangles_bytes, late=True)
def from_mesh_with_triangles(
    mesh: MeshLike | Surface,
    voxel_size: float,
    *,
    half_width: float | tuple[float, float] = DEFAULT_HALF_WIDTH,
    sign: str = "auto",
    thickness: float | None = None,
    interior: str = "remove",
    name: str | None = None,
    device: Device = None,
) -> MeshBand:
    """Build the field of :func:`from_mesh`, with the nearest triangle of each active voxel.

    Ties go to the lowest triangle, as for ``Surface.closest_point``. All arguments are as for :func:`from_mesh`.

    Args:
        mesh: Triangles, or a Surface of them.
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on either side [voxels], or a pair of widths, outside and inside.
        sign: Method that tells inside from outside.
        thickness: Thickness [world] of a shell around the surface.
        interior: What happens to surface inside of solids, "remove" or "keep"; rows are those of the given mesh.
        name: Name of the grid of distances; the other is named "triangle_id".
        device: Where to compute.
    Returns:
        MeshBand of the distances and an int32 grid: the row of the nearest face at active voxels, -1 elsewhere.
    Raises:
        InputError, DeviceMemoryError: As for :func:`from_mesh`.
    """
    surface, shape, lattice = _prepared(mesh, voxel_size, half_width, sign, thickness, interior, device)
    head = grid_head(shape, lattice, surface.mesh.name if name is None else name)
    band = make_band(lattice, shape, with_slots=True)
    metadata = band_metadata(band, sign)
    distance = build_band(band, head)
    head = checked_head("int32", -1, -1, lattice.transform, "triangle_id", "unknown")
    identity = build_triangle_ids(band, head, source_of(surface.mesh))
    return MeshBand(volume_from_built(distance, metadata), volume_from_built(identity, metadata))


def _prepared(
    mesh: Any,
    voxel_size: float,
    half_width: Any,
    sign: str,
    thickness: float | None,
    interior: str,
    device: Any,
    compact: bool = False,
) -> tuple[Surface, BandShape, Lattice]:
    voxel_size = user_arrays.require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    outside, inside = half_widths(half_width)
    surface, method, offset = resolve_surface(mesh, sign, thickness, interior, device, voxel_size)
    shape = BandShape(in_float32(outside * voxel_size), in_float32(inside * voxel_size), offset, method)
    start = band_start(surface, shape.reach, TILE_VOXELS * voxel_size) if compact else None
    return surface, shape, Lattice(surface, voxel_size, shape.reach, shape.hollow, translation=start)


def _by_openvdb(surface: Surface, lattice: Lattice, shape: BandShape, name: str) -> SparseVolume:
    from geokit import native

    if shape.method == "none" or not math.isclose(shape.exterior, shape.interior):
        raise InputError("method: 'openvdb' makes signed fields of one half_width; use method='geokit'")
    mesh = surface.mesh
    half_width = shape.exterior / lattice.voxel_size
    buffer = native.mesh_to_level_set(
        mesh.vertices, mesh.faces, voxel_size=lattice.voxel_size, half_width=max(1.0, half_width)
    )
    metadata = {**_origin(surface, lattice), "geokit:sign_method": "openvdb", **mesh_metadata(mesh)}
    return SparseVolume(buffer, info_of(buffer, metadata, name=name))
