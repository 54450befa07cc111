"""Narrow-band distance fields of triangle meshes; only the tiles near the surface are touched."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from geokit import _arrays
from geokit.errors import InputError
from geokit.volume._band import BandShape, build_band, build_triangle_ids, make_band
from geokit.volume._grid_head import checked_head
from geokit.volume._nanovdb import info_of
from geokit.volume._provenance import content_hash, provenance
from geokit.volume._tiles import Lattice
from geokit.volume._upload import made_on_device
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    from geokit.mesh.model import TriangleMesh
    from geokit.mesh.surface import Surface
    from geokit.volume._band import Band
    from geokit.volume._device_build import BuiltGrid

__all__ = [
    "SIGNS",
    "MeshBand",
    "as_volume",
    "described",
    "field_of",
    "from_mesh",
    "from_mesh_with_triangles",
    "half_widths",
    "hash_of",
    "head_of",
    "in_float32",
]

METHODS = ("geokit", "openvdb")
_hashes: WeakKeyDictionary[TriangleMesh, str] = WeakKeyDictionary()
SIGNS = ("auto", "winding", "pseudonormal", "parity", "none")
DEFAULT_HALF_WIDTH = 3.0

# Of meshes, for as long as they live.
_pieces: WeakKeyDictionary[Any, tuple[NDArray[np.int32], int]] = WeakKeyDictionary()


class MeshBand(NamedTuple):
    """Outcome of :func:`from_mesh_with_triangles`: a field, and the triangle that each of its voxels is nearest to.

    Attributes:
        distance: What :func:`from_mesh` gives.
        triangle_id: int32 grid with the same active voxels: row of the nearest face, -1 elsewhere.
    """

    distance: SparseVolume
    triangle_id: SparseVolume


def from_mesh(
    mesh: TriangleMesh | Surface,
    voxel_size: float | None = None,
    *,
    tolerance: float | None = None,
    within: float | None = None,
    order: int | None = None,
    half_width: float | tuple[float, float] | None = None,
    sign: str = "auto",
    thickness: float | None = None,
    method: str = "geokit",
    codec: str | None = None,
    name: str | None = None,
    device: Any = None,
) -> SparseVolume:
    """Distance to a mesh on the voxels near its surface, negative inside, as a NanoVDB level set.

    Distances at active voxels are those of ``Surface.closest_point``, rounded to float32: exact for the float64
    triangle that wins. Active are the voxels that are nearer than the band is wide; elsewhere the value is the
    exterior's width outside (the background) and minus the interior's inside. Signs are those of
    ``Surface.signed_distance``: on closed meshes a few voxels are asked and the others follow from their distances, on
    open ones every active voxel is asked. The same bytes for any number of threads; on CUDA within two roundings of
    those of the CPU. Tested against brute force in tests/unit/test_from_mesh.py.

    Voxel centres lie at whole multiples of ``voxel_size``; the transform has a translation (of whole voxels) only
    where indices would otherwise exceed 2^20, and with ``tolerance``, where index 0 is where the band begins.

    With ``tolerance`` instead of ``voxel_size`` the voxel size, and whatever of half width, order and codec is not
    given, are those of least memory with which ``sample`` is within the tolerance of the exact distance, wherever it is
    checked: at 120,000 points no farther than ``within`` from the surface and at some 80,000 more around the worst of
    them, none of them used to choose. ``info.order`` is the order that was chosen, and what ``sample`` and
    ``gradient`` take where they are not told another; ``info.achieved_error`` is the largest error that the check
    found, ``info.achieved_error_999`` its 99.9th percentile. Rays and surfaces are those of the trilinear interpolant:
    use ``order=1`` where that is what has to be right. :func:`geokit.volume.plan` lists the choices. On all meshes of
    tests/property/test_from_mesh_tolerance.py the tolerance holds on other points than those that were checked, too; on
    those of them that it searches exhaustively the memory is within 1.5 times of the least.

    ``info.metadata`` says where the field is from: "geokit:source" (the mesh's name), "geokit:source_sha256" (of its
    vertices and faces), "geokit:voxel_size", "geokit:version", "geokit:sign_method" and "geokit:sign_reason";
    "geokit:lost_components" lists the connected pieces of the mesh, counted in the order of their first faces, that are
    too thin to hold a single negative voxel; a UserWarning tells of them too.

    Sampled at order 1, points inside walls of 2 voxels and more are inside; around the middle of any wall the
    interpolated distance is up to half a voxel off, and walls thinner than a voxel may have no inside. Up to 1e9 sizes
    from the origin distances are right to 1e-6 of the size. Held by tests/stability/test_envelopes.py.

    Args:
        mesh: Triangles, or a Surface of them, whose tree is then used (and its device).
        voxel_size: Edge length of a voxel [world]; either this or ``tolerance``.
        tolerance: Largest error of the interpolated distance [world].
        within: How far from the surface the tolerance holds [world]; None for the tolerance itself, or a quarter of it
            where the mesh is open: beside an open border the sign jumps, and so does the field, by twice the distance.
        order: With ``tolerance``: the order of interpolation that will be used, 1, 2 or 3; None for the best.
        half_width: Width of the band on either side of the surface [voxels], at least 1 (3 where None, with
            ``tolerance`` as little as interpolation needs); or a pair of widths, outside and inside.
        sign: How inside is told from outside, as for ``Surface.signed_distance``; "auto" is what
            ``Surface.sign_method`` says. "none" gives unsigned distances, a grid of class "unknown".
        thickness: Thickness [world] of a solid shell around the surface, of which the field is then the level set: the
            unsigned distance less half of it. ``sign`` is of no use then.
        method: "geokit", or "openvdb" for the field that OpenVDB makes of a closed mesh, for comparison: it is up to
            half a voxel off.
        codec: How to store the values, as :func:`geokit.volume.quantize` takes it; None for float32, with ``tolerance``
            for the best.
        name: Name of the grid; the mesh's name where None.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU. On a GPU the
            grid stays there until ``nanovdb`` is asked for.
    Returns:
        SparseVolume of type "float" and class "level set".
    Raises:
        InputError: An argument out of range, options that exclude each other, the mesh without faces, voxels too small
            to be counted, or a tolerance that cannot be kept; the message says which could.
        DeviceMemoryError: The band needs more memory than there is, or more than a grid's 2^31 bytes; the message says
            which voxel size would fit, or which tolerance.
        MissingDependencyError: ``method`` is "openvdb" and geokit was built without it.
    Source:
        Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology" (2013), for the structure. Differs:
        distances are exact at every active voxel.
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
    if (voxel_size is None) == (tolerance is None):
        raise InputError(
            f"voxel_size: {'nothing' if tolerance is None else 'tolerance as well'} given; give either voxel_size or "
            "tolerance"
        )
    if tolerance is not None:
        asked = {"within": within, "order": order, "half_width": half_width, "thickness": thickness, "codec": codec}
        from geokit.volume._from_mesh_tolerance import within_tolerance

        return within_tolerance(mesh, tolerance, {**asked, "device": device}, sign, method, name)
    assert voxel_size is not None
    for option, value in (("within", within), ("order", order)):
        if value is not None:
            raise InputError(f"{option}: only of use with tolerance; leave it out")
    half_width = DEFAULT_HALF_WIDTH if half_width is None else half_width
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not known; use one of {', '.join(map(repr, METHODS))}")
    if codec is not None:
        from geokit.volume.quantize import CODECS

        if codec not in CODECS:
            raise InputError(f"codec: {codec!r} is not known; use one of {', '.join(map(repr, CODECS))}")
    surface, shape, lattice = _prepared(mesh, voxel_size, half_width, sign, thickness, device)
    head = head_of(shape, lattice, surface.mesh.name if name is None else name)
    if method == "openvdb":
        volume = _by_openvdb(surface, lattice, shape, surface.mesh.name if name is None else name)
    else:
        band = make_band(lattice, shape)
        volume = as_volume(build_band(band, head), described(band, sign))
    if codec is None:
        return volume
    from geokit.volume.quantize import quantize

    return quantize(volume, codec)


def from_mesh_with_triangles(
    mesh: TriangleMesh | Surface,
    voxel_size: float,
    *,
    half_width: float | tuple[float, float] = DEFAULT_HALF_WIDTH,
    sign: str = "auto",
    thickness: float | None = None,
    name: str | None = None,
    device: Any = None,
) -> MeshBand:
    """As :func:`from_mesh`, with the nearest triangle of each active voxel.

    Ties go to the lowest triangle, as for ``Surface.closest_point`` (tests/unit/test_from_mesh.py).

    Args:
        mesh: As :func:`from_mesh`, and so are the others.
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on either side [voxels], or a pair of widths, outside and inside.
        sign: How inside is told from outside.
        thickness: Thickness [world] of a shell around the surface.
        name: Name of the grid of distances; the other is named "triangle_id".
        device: Where to compute.
    Returns:
        MeshBand of the distances and an int32 grid: the row of the nearest face at active voxels, -1 elsewhere.
    Raises:
        InputError: As :func:`from_mesh`.
        DeviceMemoryError: As :func:`from_mesh`.
    """
    surface, shape, lattice = _prepared(mesh, voxel_size, half_width, sign, thickness, device)
    head = head_of(shape, lattice, surface.mesh.name if name is None else name)
    band = make_band(lattice, shape, with_slots=True)
    metadata = described(band, sign)
    distance = build_band(band, head)
    head = checked_head("int32", -1, -1, lattice.transform, "triangle_id", "unknown")
    identity = build_triangle_ids(band, head)
    return MeshBand(as_volume(distance, metadata), as_volume(identity, metadata))


def field_of(
    mesh: TriangleMesh | Surface, sign: str, thickness: float | None, device: Any
) -> tuple[Surface, str, float]:
    """The surface, how its signs are told (or "none"), and half the thickness of a shell."""
    from geokit.mesh.surface import Surface

    if sign not in SIGNS:
        raise InputError(f"sign: {sign!r} is not a method; use one of {', '.join(map(repr, SIGNS))}")
    offset = 0.0
    if thickness is not None:
        offset = 0.5 * _arrays.require_finite_scalar(thickness, "thickness", low=0.0)
        sign = "none"
    surface = mesh if isinstance(mesh, Surface) else Surface(mesh, device=device)
    return surface, "none" if sign == "none" else surface._method(sign), offset


def _prepared(
    mesh: Any, voxel_size: float, half_width: Any, sign: str, thickness: float | None, device: Any
) -> tuple[Surface, BandShape, Lattice]:
    voxel_size = _arrays.require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    exterior, interior = half_widths(half_width)
    surface, method, offset = field_of(mesh, sign, thickness, device)
    shape = BandShape(in_float32(exterior * voxel_size), in_float32(interior * voxel_size), offset, method)
    return surface, shape, Lattice(surface, voxel_size, shape.reach, shape.hollow)


def half_widths(half_width: Any) -> tuple[float, float]:
    pair = tuple(half_width) if isinstance(half_width, (tuple, list)) else (half_width, half_width)
    if len(pair) != 2:
        raise InputError(f"half_width: {half_width!r} has {len(pair)} widths; give one, or a pair: outside and inside")
    widths = [_arrays.require_finite_scalar(width, "half_width") for width in pair]
    if min(widths) < 1.0:
        raise InputError(f"half_width: {min(widths)} voxels cannot hold a sign change on each side; use at least 1")
    return widths[0], widths[1]


def in_float32(value: float) -> float:
    with np.errstate(over="ignore"):
        return float(np.float32(value))


def head_of(shape: BandShape, lattice: Lattice, name: str) -> Any:
    level_set = shape.method != "none" or shape.offset > 0.0
    grid_class = "level set" if level_set else "unknown"
    inside = -shape.interior if level_set else shape.exterior
    return checked_head("float", shape.exterior, inside, lattice.transform, name, grid_class)


def described(band: Band, sign: str, *, warn: bool = True) -> dict[str, Any]:
    """Metadata of the fields that are made from a band; may warn of the pieces of the mesh that it lost."""
    surface, method = band.lattice.surface, band.shape.method
    reason = surface.sign_reason if sign == "auto" and method != "none" else "asked for"
    metadata: dict[str, Any] = {
        **_origin(surface, band.lattice),
        "geokit:sign_method": "shell" if band.shape.offset else method,
        "geokit:sign_reason": reason,
    }
    if method != "none":
        from geokit.volume._band_lost import lost_components

        lost = lost_components(band, *_pieces_of(surface.mesh))
        if lost:
            metadata["geokit:lost_components"] = " ".join(map(str, lost))
        if lost and warn:
            warnings.warn(
                f"{surface.mesh.name or 'mesh'}: {len(lost)} of its pieces are too thin for voxels of "
                f"{band.lattice.voxel_size:g} and have no inside in the grid (the first is {lost[0]}); use smaller "
                'voxels, or thickness; metadata "geokit:lost_components" lists them',
                UserWarning,
                stacklevel=3,
            )
    return metadata


def _pieces_of(mesh: TriangleMesh) -> tuple[NDArray[np.int32], int]:
    """Connected piece of each face, counted in the order of their first faces, and how many there are.

    Looked up where the mesh is known.
    """
    if mesh not in _pieces:
        from geokit.mesh.audit import face_parts

        labels = face_parts(mesh)
        if (labels == labels[0]).all():
            _pieces[mesh] = np.zeros(len(labels), np.int32), 1
        else:
            _, first_face, piece = np.unique(labels, return_index=True, return_inverse=True)
            numbers = np.argsort(np.argsort(first_face))[piece.reshape(-1)].astype(np.int32)
            _pieces[mesh] = numbers, len(first_face)
    return _pieces[mesh]


def _origin(surface: Surface, lattice: Lattice) -> dict[str, Any]:
    """Metadata of where a field is from."""
    mesh = surface.mesh
    return provenance(mesh.name, hash_of(mesh), lattice.voxel_size)


def hash_of(mesh: TriangleMesh) -> str:
    # Hashing takes as long as a small band: once for each mesh.
    if mesh not in _hashes:
        _hashes[mesh] = content_hash(mesh.vertices, mesh.faces)
    return _hashes[mesh]


def as_volume(grid: BuiltGrid, metadata: dict[str, Any]) -> SparseVolume:
    if grid.host is None:
        return made_on_device(grid.buffer, info_of(grid.head, metadata, byte_count=len(grid.buffer)))
    return SparseVolume(grid.host, info_of(grid.host, metadata))


def _by_openvdb(surface: Surface, lattice: Lattice, shape: BandShape, name: str) -> SparseVolume:
    from geokit import native

    if shape.method == "none" or not math.isclose(shape.exterior, shape.interior):
        raise InputError("method: 'openvdb' makes signed fields of one half_width; use method='geokit'")
    mesh = surface.mesh
    half_width = shape.exterior / lattice.voxel_size
    buffer = native.mesh_to_level_set(
        mesh.vertices, mesh.faces, voxel_size=lattice.voxel_size, half_width=max(1.0, half_width)
    )
    metadata = {**_origin(surface, lattice), "geokit:sign_method": "openvdb"}
    return SparseVolume(buffer, info_of(buffer, metadata, name=name))
