"""Steps that all builders of narrow bands share: the prepared surface, half widths, grid heads, metadata."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.snapshot import snapshot
from geokit.core.interop import user_arrays
from geokit.core.interop.types import MeshLike
from geokit.core.memory.pinned import host_flags
from geokit.core.require import described, require_choice
from geokit.errors import InputError, MissingDependencyError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.points import ClosestPoints
from geokit.mesh.sign.queries import SIGN_METHODS
from geokit.mesh.surfaces.surface import Surface
from geokit.volume.band.band import BandShape
from geokit.volume.band.tiles import Lattice
from geokit.volume.model.sparse_volume import SparseVolume, made_on_device
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.provenance import INTERIOR, content_hash, provenance, world_metadata
from geokit.volume.tree.grid_head import checked_head

if TYPE_CHECKING:
    from geokit.volume.band.band import Band
    from geokit.volume.tree.device_writer import BuiltGrid

# Thickest shell, in lengths of the mesh's longest edge of its bounding box: float32 sees a point in the middle of it.
THICKEST = 1e6
# Surface inside of a body that crosses itself stays this far from where it does, as a share of a voxel, or of the
# tolerance.
LEFT_INSIDE = 0.25


class _Origin(NamedTuple):
    """What the mesh of a boundary was made from: the mesh that was given, and the face in which each face lies."""

    mesh: TriangleMesh
    source: NDArray[np.int64]
    partly: bool


def resolve_surface(
    mesh: MeshLike | Surface, sign: str, thickness: float | None, interior: str, device: Any, detail: float
) -> tuple[Surface, str, float]:
    """The prepared surface, its sign method (or "none"), and half the thickness of a shell.

    Where closed bodies cross themselves, or could not be united, surface inside of the solid stays as far as a share
    LEFT_INSIDE of ``detail`` [world] from where they cross.

    Raises:
        InputError: ``thickness`` is negative, not finite, or beyond ``THICKEST``; there is no such sign method, or no
            such ``interior``.
    """
    require_choice(sign, "sign", SIGNS)
    require_choice(interior, "interior", INTERIORS)
    offset = 0.0
    if thickness is not None:
        offset = 0.5 * user_arrays.require_finite_scalar(thickness, "thickness", low=0.0)
        sign = "none"
    surface = snapshot(mesh) if isinstance(mesh, Surface) else Surface(mesh, device=launcher.resolve_device(device))
    longest = float((surface.bounds[1] - surface.bounds[0]).max())
    if 2.0 * offset > THICKEST * longest > 0.0:
        raise InputError(
            f"thickness: {2.0 * offset:g} is more than {THICKEST:g} times the size of the mesh, {longest:g}; "
            "give one in the mesh's units"
        )
    # By parity, bodies within others are holes; who asks for pseudonormals says that there are no such bodies.
    if interior == "remove" and sign in ("auto", "winding"):
        boundary, kept = surface._cache.find("boundary", lambda: _without_interior(surface))
        surface = boundary or surface
        if kept:
            surface, kept = _trimmed(surface, kept, LEFT_INSIDE * detail)
        if kept:
            warn(
                f"{surface.mesh.name or 'mesh'}: bodies touch or overlap, and surface inside of the solid stays in the "
                f'field, because {kept}; interior="keep" is silent'
            )
    method = "none" if sign == "none" else surface._solid_method(sign)
    # Who asks for a method has looked at the mesh; for "auto" the audit has been made.
    open_edges = surface._signs.audit.boundary_edge_count if sign == "auto" else 0
    if open_edges:
        warn(
            f"{surface.mesh.name or 'mesh'}: is open ({open_edges} boundary edges), and so is its field: in a hole the "
            "sign changes as far as the band reaches, and mesh.from_volume ends there; a larger half_width closes "
            "holes of that size, thickness makes a solid shell, a sign method by name is silent"
        )
    return surface, method, offset


def _without_interior(surface: Surface) -> tuple[Surface | None, str]:
    """The surface of what a mesh encloses, None if that is all of it, and why some is still inside of solids."""
    from geokit.mesh.solids.boundary import boundary_of

    try:
        boundary = boundary_of(surface)
    except MissingDependencyError as error:
        return None, str(error)
    if boundary.source is None:
        return None, boundary.kept
    boundary.mesh._cache.keep("origin", _Origin(surface.mesh, boundary.source, bool(boundary.kept)))
    return Surface(boundary.mesh, device=surface._device), boundary.kept


def _trimmed(surface: Surface, kept: str, length: float) -> tuple[Surface, str]:
    """A surface without what lies inside of the solid, and why some stays, "" if none; the same where it is open."""
    from geokit.mesh.solids.trimming import trimmed
    from geokit.volume.band.fields import TrimmedSurface

    found = trimmed(surface, length)
    if found is None:
        return surface, kept
    mesh, source = found
    origin = _origin_of(surface.mesh)
    given, rows = (surface.mesh, source) if origin is None else (origin.mesh, origin.source[source])
    mesh._cache.keep("origin", _Origin(given, rows, False))
    return TrimmedSurface(mesh, surface), ""


def source_of(mesh: TriangleMesh) -> NDArray[np.int64] | None:
    """Row of the given mesh's face in which each face lies (F,), if surface inside of solids was removed."""
    origin = _origin_of(mesh)
    return None if origin is None else origin.source


def mesh_metadata(mesh: TriangleMesh) -> dict[str, Any]:
    """What metadata say of the mesh: its unit, the axis that is up, and whether surface inside of solids is gone."""
    origin = _origin_of(mesh)
    given = mesh if origin is None else origin.mesh
    interior = {} if origin is None else {INTERIOR: "partly removed" if origin.partly else "removed"}
    return {**world_metadata(given.meters_per_unit, given.up_axis), **interior}


def _origin_of(mesh: TriangleMesh) -> _Origin | None:
    return mesh._cache.find("origin", lambda: None)


def half_widths(half_width: Any) -> tuple[float, float]:
    pair = tuple(half_width) if isinstance(half_width, (tuple, list)) else (half_width, half_width)
    if len(pair) != 2:
        raise InputError(
            f"half_width: {described(half_width)} has {len(pair)} widths; give one, or a pair: outside and inside"
        )
    widths = [user_arrays.require_finite_scalar(width, "half_width") for width in pair]
    if min(widths) < 1.0:
        raise InputError(f"half_width: {min(widths)} voxels cannot hold a sign change on each side; use at least 1")
    return widths[0], widths[1]


def in_float32(value: float) -> float:
    with np.errstate(over="ignore"):
        return float(np.float32(value))


def grid_head(shape: BandShape, lattice: Lattice, name: str) -> Any:
    level_set = shape.method != "none" or shape.offset > 0.0
    grid_class = "level set" if level_set else "unknown"
    inside = -shape.interior if level_set else shape.exterior
    return checked_head("float", shape.exterior, inside, lattice.transform, name, grid_class)


def band_metadata(band: Band, sign: str, *, say_lost: bool = True) -> dict[str, Any]:
    """Metadata of the fields that are built from a band; ``say_lost`` warns of mesh components that it has lost."""
    surface, method = band.lattice.surface, band.shape.method
    reason = surface._solid_choice.reason if sign == "auto" and method != "none" else "asked for"
    metadata: dict[str, Any] = {
        **_origin(surface, band.lattice),
        "geokit:sign_method": "shell" if band.shape.offset else method,
        "geokit:sign_reason": reason,
        **mesh_metadata(surface.mesh),
    }
    if method != "none":
        from geokit.volume.band.signs import lost_components

        lost = lost_components(band, *_pieces_of(surface.mesh))
        if lost:
            metadata["geokit:lost_components"] = " ".join(map(str, lost))
        if lost and say_lost:
            pairs = surface._signs.audit.back_to_back_count
            why, remedy = f"too thin for voxels of {band.lattice.voxel_size:g}", "smaller voxels, or thickness"
            if pairs:
                why, remedy = f"too thin, or {pairs} pairs of faces back to back that bound no volume,", "thickness"
            warn(
                f"{surface.mesh.name or 'mesh'}: {len(lost)} of its pieces are {why} and have no inside in the grid "
                f'(the first is {lost[0]}); use {remedy}; metadata "geokit:lost_components" lists them'
            )
    return metadata


def volume_from_built(grid: BuiltGrid, metadata: dict[str, Any]) -> SparseVolume:
    if grid.host is None:
        return made_on_device(grid.buffer, info_of(grid.head, metadata, byte_count=grid.size))
    return SparseVolume(grid.host, info_of(grid.host, metadata))


SIGNS = (*SIGN_METHODS, "none")


# What happens to surface that has the solid on both sides.
INTERIORS = ("remove", "keep")


def _pieces_of(mesh: TriangleMesh) -> tuple[NDArray[np.int32], int]:
    """Connected component of each face, numbered in the order of their first faces, and their count; cached."""

    def find() -> tuple[NDArray[np.int32], int]:
        from geokit.mesh.topology.audit import face_parts

        origin = _origin_of(mesh)
        if origin is not None:
            pieces, count = _pieces_of(origin.mesh)
            return pieces[origin.source], count
        labels = face_parts(mesh)
        if (labels == labels[0]).all():
            return np.zeros(len(labels), np.int32), 1
        _, first_face, piece = np.unique(labels, return_index=True, return_inverse=True)
        return np.argsort(np.argsort(first_face))[piece.reshape(-1)].astype(np.int32), len(first_face)

    return mesh._cache.find("pieces", find)


def _origin(surface: Surface, lattice: Lattice) -> dict[str, Any]:
    """Metadata of a field's origin."""
    mesh = surface.mesh
    return provenance(mesh.name, hash_of(mesh), lattice.voxel_size)


def hash_of(mesh: TriangleMesh) -> str:
    origin = _origin_of(mesh)
    if origin is not None:
        return hash_of(origin.mesh)
    # Hashing takes as long as building a small band, so each mesh is hashed once.
    return mesh._cache.find("content hash", lambda: content_hash(mesh.vertices, mesh.faces))


class TrimmedSurface(Surface):
    """A surface without faces that have the same on both sides; what is inside is said by the winding numbers of all.

    Args:
        mesh: The faces that are left, or their pieces; where some are missing there may be holes.
        given: The surface of all faces.
    """

    _is_trimmed = True

    def __init__(self, mesh: TriangleMesh, given: Surface) -> None:
        super().__init__(mesh, device=given._device)
        self.__dict__.update(_single_faced=given._signs, _solid_choice=given._solid_choice)

    def contains(self, points: Any, *, sign: str = "auto", **options: Any) -> Any:
        """Whether points lie inside: also those on faces that were left out, where :class:`Surface` says no."""
        winding = self._signs.winding_number(points, **options)
        if isinstance(winding, wp.array):
            return wp.array(winding.numpy() > 0.5, dtype=wp.bool, device=winding.device)
        return winding > 0.5

    def _sign(self, method: str, points: "wp.array", closest: ClosestPoints, reach: float) -> None:
        from geokit.mesh.sign.parity_kernels import take_sign_kernel

        winding = self._signs._winding(points, host_flags(1, self._device)).numpy()
        side = wp.array(np.where(winding > 0.5, -1.0, 1.0), dtype=wp.float64, device=self._device)
        launcher.launch(take_sign_kernel, len(points), [side], [closest.distance], self._device)
