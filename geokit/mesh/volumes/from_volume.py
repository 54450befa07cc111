"""The isosurface of a sparse volume as a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core import launcher
from geokit.core.blocks.chunked_queries import Progress
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_callable, require_choice, require_number
from geokit.errors import InputError, UnsupportedGridError
from geokit.mesh._simplify import BYTES_PER_SIMPLIFIED, Simplified, within_tolerance
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.volume._statistics import statistics
from geokit.volume.nanovdb.header import aligned_buffer, grid_class_code, grid_header
from geokit.volume.nanovdb.types import ISOSURFACE_TYPES, TYPES
from geokit.volume.tree.estimates import require_openvdb_room
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    from geokit.mesh._simplify import Simplified
    from geokit.volume.model.sparse_volume import SparseVolume

METHODS = ("auto", "surface_nets", "marching_cubes", "dual_contouring", "openvdb")
# No voxel has an index beyond this.
LARGEST_INDEX = 2.0**31


def _bytes(
    volume: SparseVolume, isovalue: float = 0.0, *, tolerance: float | None = None, method: str = "auto", **_: Any
) -> float:
    """Of a band of three voxels on each side, which has three voxels for each face."""
    faces = (volume.info.active_voxel_count or 0) / 3
    return faces * (BYTES_PER_SIMPLIFIED if tolerance is not None else 140 if method == "openvdb" else 50)


@needs(_bytes, late=True)
def from_volume(
    volume: SparseVolume,
    *,
    isovalue: float = 0.0,
    adaptivity: float = 0.0,
    tolerance: float | None = None,
    method: str = "auto",
    device: Device = None,
    progress: Progress | None = None,
) -> TriangleMesh:
    """Extract the isosurface of a sparse volume as a triangle mesh.

    The surface is that of the interpolant of ``volume.sample`` at order 1: voxels below the isovalue are inside, and
    tiles count with their value. It ends where no voxel is active: a crossing between two inactive voxels gives no
    face. Elsewhere the mesh is watertight, oriented, and manifold at edges and vertices, for every field. Normals point
    outward: toward increasing values, as in a signed distance field, but toward decreasing values in a fog volume, and
    in a grid of class "unknown" whose background is below the isovalue, as of a mask or an image: what has no end is
    outside. A field that does not cross the isovalue gives a mesh without faces.

    - "surface_nets": one vertex for each sheet of the surface in a cell, at the mean of the crossings on the cell's
      edges; quads are split along their shorter diagonal. Triangles are evenly shaped. The error falls with the square
      of the voxel size where the surface is smooth (0.021 voxel on a sphere of 16 voxels); edges are rounded off by up
      to a voxel, 0.45 rms.
    - "marching_cubes": a vertex at each crossing. Vertices lie on the interpolant to 1e-6 voxel, and within 0.008 voxel
      on the same sphere. As many triangles, some of them thin; edges are cut off by up to a voxel, 0.4 rms.
    - "dual_contouring": as surface nets, but each vertex lies where the planes through the crossings meet. This keeps
      the edges and corners of the field: exactly where they are aligned with the grid, else to 0.1 voxel rms and 0.75
      at most. Made for distance fields. Sheets that touch may have vertices at equal positions.
    - "openvdb": OpenVDB's own surface nets, the only method that merges flat regions (``adaptivity``). Where voxels
      equal the isovalue, its vertices may coincide; merging them makes the mesh non-manifold.
    - "auto": "openvdb" if adaptivity is above 0, else "surface_nets".

    ``tolerance`` reduces the number of triangles, with large ones where the surface is flat: the mesh is simplified as
    by :func:`geokit.mesh.simplify`, and no point of either surface is farther than the tolerance from the other.
    :func:`from_volume_with_deviation` also returns the deviation that was reached. At equal distance, this leaves a
    fraction of the faces that ``adaptivity`` leaves (docs/design/simplification.md).

    Results do not depend on the number of threads.

    For a distance field the error of the surface is at most 1.5 voxel^2 (marching cubes 1.0) over the radius of
    curvature, down to a radius of 1 voxel; balls of less than 0.87 voxel may be lost. Isovalues are valid up to
    half_width - 1 voxels from the surface; walls must be at least 2 voxels thick. Where no value crosses the isovalue,
    the mesh is empty, and a UserWarning gives the range of the values.

    Args:
        volume: A scalar grid of floating point or quantized values.
        isovalue: Value of the surface, in the grid's units.
        adaptivity: 0 keeps every face; toward 1, flat regions are merged into fewer and larger faces.
        tolerance: Largest distance from the mesh with every face [world]; None keeps every face.
        method: One of the above.
        device: Where to compute; None for the first GPU, else the CPU. "openvdb" always runs on the CPU.
        progress: Called as ``progress(percent, 100)`` while faces are merged within a tolerance.

    Returns:
        TriangleMesh with the grid's name, and its unit and up axis where ``info`` says them. A mesh made on a GPU stays
        there until its arrays are read. Its kernels may still run when the call returns; reads and queries wait for
        them.

    Raises:
        InputError: The grid is not scalar, isovalue is not finite, adaptivity is outside [0, 1] or the method does not
            support it, tolerance is not a positive finite number or was given with adaptivity, or the method or the
            device does not exist.
        UnsupportedGridError: A scalar grid without an isosurface: integers, bool, mask.
        MissingDependencyError: The method is "openvdb", and geokit was built without OpenVDB.
        DeviceMemoryError: There is not enough memory.

    Source:
        Gibson, Constrained Elastic Surface Nets (1998); Lorensen and Cline, Marching Cubes (1987); Ju et al., Dual
        Contouring of Hermite Data (2002), also as in OpenVDB's VolumeToMesh.

    Example:
        >>> bracket = gk.volume.from_mesh(gk.mesh.load("data/samples/bracket.obj"), 0.5)
        >>> gk.mesh.audit(gk.mesh.from_volume(bracket)).watertight
        True
    """
    isovalue = require_number(isovalue, "isovalue")
    if not np.isfinite(isovalue):
        raise InputError(f"isovalue: {isovalue} is not finite; give a value between the grid's least and greatest")
    adaptivity = require_number(adaptivity, "adaptivity")
    if not 0.0 <= adaptivity <= 1.0:
        raise InputError(f"adaptivity: {adaptivity} is outside [0, 1]; 0 keeps every face, 1 merges the most")
    require_choice(method, "method", METHODS)
    if adaptivity > 0.0 and method not in ("auto", "openvdb"):
        raise InputError(f"adaptivity: {method} cannot merge faces; use 0, or method 'openvdb'")
    if tolerance is not None:
        if adaptivity > 0.0:
            raise InputError("adaptivity: it merges faces by no known distance; leave it out where tolerance is given")
        return from_volume_with_deviation(
            volume, tolerance=tolerance, isovalue=isovalue, method=method, device=device, progress=progress
        ).mesh
    if progress is not None:
        require_callable(progress, "progress")
    _require_real(volume)
    from geokit.mesh.model.device_mesh import mesh_on_device

    target = launcher.resolve_device(device)
    if method == "openvdb" or adaptivity > 0.0:
        return _told(_by_openvdb(volume, isovalue, adaptivity), volume, isovalue)
    transform = volume.info.transform
    is_mirrored = bool(np.linalg.slogdet(transform[:3, :3])[0] < 0.0)
    turned = is_mirrored != _encloses_large_values(volume, isovalue)
    if method == "marching_cubes":
        from geokit.volume.isosurface.surface_nets import marching_cubes

        arrays = marching_cubes(volume, isovalue, target, turned=turned)
    else:
        from geokit.volume.isosurface.surface_nets import surface_nets

        arrays = surface_nets(volume, isovalue, target, turned=turned, sharp=method == "dual_contouring")
    said = _said(volume)
    mesh = _told(mesh_on_device(*arrays, **said), volume, isovalue)
    reach = np.abs(transform[:3, :3]).sum(axis=1) * LARGEST_INDEX + np.abs(transform[:3, 3])
    return mesh if np.isfinite(reach).all() else TriangleMesh(mesh.vertices, mesh.faces, **said)


@needs(_bytes, late=True)
def from_volume_with_deviation(
    volume: SparseVolume,
    *,
    tolerance: float,
    isovalue: float = 0.0,
    method: str = "auto",
    device: Device = None,
    progress: Progress | None = None,
) -> Simplified:
    """Extract an isosurface within a tolerance, and return how far it deviates from the mesh with every face.

    ``deviation`` bounds the distance between both meshes and is at most the tolerance. The error of the mesh with every
    face against the field comes on top; :func:`from_volume` states it.

    Args:
        volume: A scalar grid of floating point or quantized values.
        tolerance: Largest distance from the mesh with every face [world].
        isovalue: Value of the surface, in the grid's units.
        method: "auto", "surface_nets", "marching_cubes", "dual_contouring" or "openvdb", as in :func:`from_volume`.
        device: Where to compute; None for the first GPU, else the CPU.
        progress: Called as ``progress(percent, 100)`` while faces are merged.

    Returns:
        Simplified with mesh, deviation and deviation_p999 [world].

    Raises:
        InputError: tolerance is not a positive finite number, or as for :func:`from_volume`.
        UnsupportedGridError: A scalar grid without an isosurface: integers, bool, mask.
        MissingDependencyError: The method is "openvdb", and geokit was built without OpenVDB.
        DeviceMemoryError: There is not enough memory.

    Example:
        >>> torus = gk.volume.load("data/samples/torus.vdb")
        >>> found = gk.mesh.from_volume_with_deviation(torus, tolerance=0.01)
        >>> len(found.mesh.faces) < len(gk.mesh.from_volume(torus).faces), found.deviation <= 0.01
        (True, True)
    """
    tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
    if progress is not None:
        require_callable(progress, "progress")
    mesh = from_volume(volume, isovalue=isovalue, method=method, device=device)
    if mesh.face_count == 0:
        return Simplified(mesh, 0.0, 0.0)
    return within_tolerance(mesh, tolerance, launcher.resolve_device(device), progress)


def _told(mesh: TriangleMesh, volume: SparseVolume, isovalue: float) -> TriangleMesh:
    """The mesh; a UserWarning says why it has no faces, if it has none."""
    if not mesh.face_count:
        found = statistics(volume)
        values = f"its values are {found.minimum:g} to {found.maximum:g}" if found.count else "it has no active voxel"
        warn(f"volume: grid {volume.info.name!r} has no surface at {isovalue:g}; {values}")
    return mesh


def _said(volume: SparseVolume) -> dict[str, Any]:
    """The name of a volume's mesh, and the unit and the axis that is up where the volume says them."""
    return {key: getattr(volume.info, key) for key in ("name", "meters_per_unit", "up_axis")}


def _encloses_large_values(volume: SparseVolume, isovalue: float) -> bool:
    grid_class, background = volume.info.grid_class, volume.info.background
    return grid_class == "fog volume" or (grid_class == "unknown" and bool(background < isovalue))


def _require_real(volume: SparseVolume) -> None:
    grid_type = require_volume(volume, "volume").info.grid_type
    if isinstance(volume.info.background, tuple) or "index" in grid_type:
        raise InputError(
            f"volume: grid {volume.info.name!r} of type {grid_type} is not scalar and has no isosurface; "
            "use a scalar grid, such as one component of it"
        )
    if grid_type not in ISOSURFACE_TYPES:
        remedy = f"convert it to one of {', '.join(ISOSURFACE_TYPES)}"
        if _is_whole(grid_type):
            # A mask: inside where its values are large, unlike a level set.
            remedy += (
                ', or make it of its array with volume.from_dense(..., grid_class="fog volume"), whose surface at '
            )
            remedy += "isovalue=0.5 encloses what is 1"
        raise UnsupportedGridError(f"volume: grid {volume.info.name!r} of type {grid_type} has no isosurface; {remedy}")


def _is_whole(grid_type: str) -> bool:
    """Whether voxels are whole numbers, or bits."""
    return any(kind.name == grid_type and kind.family in ("integer", "bool", "mask") for kind in TYPES)


def _by_openvdb(volume: SparseVolume, isovalue: float, adaptivity: float) -> TriangleMesh:
    from geokit import native
    from geokit.volume.isosurface.nodes import topology_of

    require_openvdb_room(volume)
    topology_of(volume).large.require_countable(isovalue)
    surface = native.volume_to_mesh(_as_level_set(volume), isovalue=isovalue, adaptivity=adaptivity)
    faces = np.concatenate([surface.triangles, _split_quads(surface.points, surface.quads)])
    if _encloses_large_values(volume, isovalue):
        faces = faces[:, ::-1]
    return TriangleMesh(surface.points, faces, **_said(volume))


def _as_level_set(volume: SparseVolume) -> NDArray[np.uint8]:
    """The buffer with grid class "level set": OpenVDB reverses the faces of every other class."""
    if volume.info.grid_class == "level set":
        return volume.nanovdb
    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    grid_header(buffer)["grid_class"] = grid_class_code("level set")
    return buffer


def _split_quads(points: NDArray[np.float64], quads: NDArray[np.int32]) -> NDArray[np.int32]:
    """Split quads (Q, 4) along their shorter diagonals into triangles (2 Q, 3) with the same winding."""
    a, b, c, d = quads.T
    first = np.sum((points[a] - points[c]) ** 2, axis=1)
    second = np.sum((points[b] - points[d]) ** 2, axis=1)
    # Ties keep the first diagonal: rounding must not decide on regular grids, where both are equal.
    along_first = (first <= second)[:, None]
    lower = np.where(along_first, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    upper = np.where(along_first, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.stack([lower, upper], axis=1).reshape(-1, 3)
