"""The isosurface of a sparse volume as a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError, UnsupportedGridError
from geokit.mesh._model import TriangleMesh
from geokit.volume.nanovdb.types import ISOSURFACE_TYPES

if TYPE_CHECKING:
    from geokit.mesh._simplify import Simplified
    from geokit.volume._model import SparseVolume

__all__ = ["from_volume", "from_volume_with_deviation"]

METHODS = ("auto", "surface_nets", "marching_cubes", "dual_contouring", "openvdb")
# No voxel has an index beyond this.
LARGEST_INDEX = 2.0**31


def from_volume(
    volume: SparseVolume,
    *,
    isovalue: float = 0.0,
    adaptivity: float = 0.0,
    tolerance: float | None = None,
    method: str = "auto",
    device: Any = None,
) -> TriangleMesh:
    """The surface on which a volume has a given value.

    The surface is that of the interpolant which ``volume.sample`` has at order 1: voxels below the isovalue are inside,
    and tiles count with their value. It ends where no voxel is active: a crossing between two voxels of which neither
    is active gives no face. Elsewhere the mesh is watertight, oriented, and manifold at edges and vertices, whatever
    the field. Normals point out of the body: to increasing values, as in a signed distance field, but in a fog volume
    to decreasing ones. A field that does not cross the value gives a mesh without faces.

    - "surface_nets": one vertex for each sheet of the surface in a cell, at the mean of the crossings on the cell's
      edges; quads, split along their shorter diagonal. Even triangles. The error falls with the square of the voxel
      size where the surface is smooth (0.021 voxel on a sphere of 16 voxels); edges are rounded off by up to a voxel,
      0.45 rms.
    - "marching_cubes": a vertex at each crossing: these lie on the interpolant to 1e-6 voxel, and within 0.008 voxel on
      the same sphere. As many triangles, thin ones among them; edges are cut off by up to a voxel, 0.4 rms.
    - "dual_contouring": as surface nets, but a vertex lies where the planes through the crossings meet, which keeps
      edges and corners that the field carries: exactly where they are square to the grid, else to 0.1 voxel rms and
      0.75 at most. Made for distance fields. Sheets that touch may have vertices at one place.
    - "openvdb": OpenVDB's own surface nets, the only ones that merge flat regions (``adaptivity``). Where voxels have
      the isovalue itself, its vertices may coincide, and the mesh is not manifold for whoever merges them.
    - "auto": "openvdb" where adaptivity is above 0, else "surface_nets".

    ``tolerance`` asks for fewer triangles, large where the surface is flat: the mesh of the method is simplified as by
    :func:`geokit.mesh.simplify`, and no point of either surface is farther than that from the other. What was achieved
    is given by :func:`from_volume_with_deviation`. For the same distance that takes a fraction of the faces that
    ``adaptivity`` leaves (docs/design/simplification.md).

    Results are the same for any number of threads. Held by tests/volume/isosurface/test_from_volume.py,
    tests/volume/isosurface/test_from_volume_property.py and tests/volume/isosurface/test_from_volume_stability.py.

    Of a distance field the surface is off by at most 1.5 voxel^2 (marching cubes 1.0) over the radius of curvature,
    down to a radius of 1 voxel; balls of less than 0.87 voxel may be lost. Isovalues are good up to half_width - 1
    voxels from the surface; walls need 2 voxels. Held by tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: A scalar grid of floating point or quantised values.
        isovalue: Value of the surface, in the grid's units.
        adaptivity: 0 keeps every face; towards 1, flat regions are merged into fewer and larger ones.
        tolerance: Largest distance from the mesh with every face [world]; None keeps every face.
        method: One of the above.
        device: Where to compute; None for the first GPU, else the CPU. "openvdb" runs on the CPU in any case.

    Returns:
        TriangleMesh with the grid's name. What a GPU makes stays there until it is read, and need not be complete when
        the call returns: reading and queries wait for it.

    Raises:
        InputError: The grid is not scalar, isovalue is not finite, adaptivity is outside [0, 1] or the method does not
            have it, tolerance is not a positive finite number or was given with adaptivity, or the method or the device
            does not exist.
        UnsupportedGridError: A scalar grid without an isosurface: integers, bool, mask.
        MissingDependencyError: geokit was built without OpenVDB, and "openvdb" was asked for.
        DeviceMemoryError: There is not enough memory.

    Source:
        Gibson, Constrained Elastic Surface Nets (1998); Lorensen and Cline, Marching Cubes (1987); Ju et al., Dual
        Contouring of Hermite Data (2002), also as in OpenVDB's VolumeToMesh.

    Example:
        >>> bracket = gk.volume.from_mesh(gk.mesh.load("data/samples/bracket.obj"), 0.5)
        >>> gk.mesh.audit(gk.mesh.from_volume(bracket)).watertight
        True
    """
    isovalue = _number(isovalue, "isovalue")
    if not np.isfinite(isovalue):
        raise InputError(f"isovalue: {isovalue} is not finite; give a value between the grid's least and greatest")
    adaptivity = _number(adaptivity, "adaptivity")
    if not 0.0 <= adaptivity <= 1.0:
        raise InputError(f"adaptivity: {adaptivity} is outside [0, 1]; 0 keeps every face, 1 merges the most")
    if method not in METHODS:
        raise InputError(f"method: {method!r} does not exist; use one of {', '.join(METHODS)}")
    if adaptivity > 0.0 and method not in ("auto", "openvdb"):
        raise InputError(f"adaptivity: {method} cannot merge faces; use 0, or method 'openvdb'")
    if tolerance is not None:
        if adaptivity > 0.0:
            raise InputError("adaptivity: it merges faces by no known distance; leave it out where tolerance is given")
        return from_volume_with_deviation(
            volume, tolerance=tolerance, isovalue=isovalue, method=method, device=device
        ).mesh
    _require_real(volume)
    if method == "openvdb" or adaptivity > 0.0:
        return _by_openvdb(volume, isovalue, adaptivity)
    from geokit.core import launcher
    from geokit.mesh._device_mesh import mesh_on_device

    target = launcher.resolve_device(device)
    transform = volume.info.transform
    is_mirrored = bool(np.linalg.slogdet(transform[:3, :3])[0] < 0.0)
    turned = is_mirrored != (volume.info.grid_class == "fog volume")
    if method == "marching_cubes":
        from geokit.volume.isosurface.marching_cubes import marching_cubes

        arrays = marching_cubes(volume, isovalue, target, turned=turned)
    else:
        from geokit.volume.isosurface.surface_nets import surface_nets

        arrays = surface_nets(volume, isovalue, target, turned=turned, sharp=method == "dual_contouring")
    mesh = mesh_on_device(*arrays, volume.info.name)
    reach = np.abs(transform[:3, :3]).sum(axis=1) * LARGEST_INDEX + np.abs(transform[:3, 3])
    return mesh if np.isfinite(reach).all() else TriangleMesh(mesh.vertices, mesh.faces, name=mesh.name)


def from_volume_with_deviation(
    volume: SparseVolume, *, tolerance: float, isovalue: float = 0.0, method: str = "auto", device: Any = None
) -> Simplified:
    """:func:`from_volume` with a tolerance, and how far the mesh is from the one with every face.

    ``deviation`` bounds the distance between both meshes, and is at most the tolerance; how far the mesh with every
    face is from the surface in the field is stated by :func:`from_volume`, and comes on top. Held by
    tests/volume/isosurface/test_from_volume.py and tests/house/test_tolerances_property.py, against brute force.

    Args:
        volume: A scalar grid of floating point or quantised values.
        tolerance: Largest distance from the mesh with every face [world].
        isovalue: Value of the surface, in the grid's units.
        method: As for :func:`from_volume`.
        device: Where to compute; None for the first GPU, else the CPU.

    Returns:
        Simplified with mesh, deviation and deviation_p999 [world].

    Raises:
        InputError: tolerance is not a positive finite number, or as for :func:`from_volume`.
        UnsupportedGridError: A scalar grid without an isosurface: integers, bool, mask.
        MissingDependencyError: geokit was built without OpenVDB, and "openvdb" was asked for.
        DeviceMemoryError: There is not enough memory.

    Example:
        >>> torus = gk.volume.load("data/samples/torus.vdb")
        >>> found = gk.mesh.from_volume_with_deviation(torus, tolerance=0.01)
        >>> len(found.mesh.faces) < len(gk.mesh.from_volume(torus).faces), found.deviation <= 0.01
        (True, True)
    """
    from geokit.core import launcher
    from geokit.mesh._simplify import Simplified, within_tolerance

    tolerance = _number(tolerance, "tolerance")
    if not 0.0 < tolerance < np.inf:
        raise InputError(f"tolerance: {tolerance} is not usable; give a finite distance greater than 0")
    mesh = from_volume(volume, isovalue=isovalue, method=method, device=device)
    if mesh.face_count == 0:
        return Simplified(mesh, 0.0, 0.0)
    return within_tolerance(mesh, tolerance, launcher.resolve_device(device))


def _require_real(volume: SparseVolume) -> None:
    grid_type = volume.info.grid_type
    if isinstance(volume.info.background, tuple) or "index" in grid_type:
        raise InputError(
            f"volume: grid {volume.info.name!r} of type {grid_type} is not scalar and has no isosurface; "
            "use a scalar grid, such as one component of it"
        )
    if grid_type not in ISOSURFACE_TYPES:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {grid_type} has no isosurface; "
            f"convert it to one of {', '.join(ISOSURFACE_TYPES)}"
        )


def _by_openvdb(volume: SparseVolume, isovalue: float, adaptivity: float) -> TriangleMesh:
    from geokit import native

    surface = native.volume_to_mesh(_as_level_set(volume), isovalue=isovalue, adaptivity=adaptivity)
    faces = np.concatenate([surface.triangles, _split_quads(surface.points, surface.quads)])
    if volume.info.grid_class == "fog volume":
        faces = faces[:, ::-1]
    return TriangleMesh(surface.points, faces, name=volume.info.name)


def _as_level_set(volume: SparseVolume) -> NDArray[np.uint8]:
    """The buffer with the class of a level set: OpenVDB turns the faces of every other class around."""
    if volume.info.grid_class == "level set":
        return volume.nanovdb
    from geokit.volume.nanovdb.header import aligned_buffer, grid_class_code, grid_header

    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    grid_header(buffer)["grid_class"] = grid_class_code("level set")
    return buffer


def _number(value: Any, name: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {value!r} is not a number; give one") from error


def _split_quads(points: NDArray[np.float64], quads: NDArray[np.int32]) -> NDArray[np.int32]:
    """Two triangles for each quad (Q, 4), along its shorter diagonal, with the quad's winding: shape (2 Q, 3)."""
    a, b, c, d = quads.T
    first = np.sum((points[a] - points[c]) ** 2, axis=1)
    second = np.sum((points[b] - points[d]) ** 2, axis=1)
    # Ties keep the first diagonal: rounding must not decide on regular grids, where both are equal.
    along_first = (first <= second)[:, None]
    lower = np.where(along_first, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    upper = np.where(along_first, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.stack([lower, upper], axis=1).reshape(-1, 3)
