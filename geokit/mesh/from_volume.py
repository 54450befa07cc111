"""The isosurface of a sparse volume as a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.mesh.model import TriangleMesh

if TYPE_CHECKING:
    from geokit.volume.model import SparseVolume

__all__ = ["from_volume"]


def from_volume(volume: SparseVolume, *, isovalue: float = 0.0, adaptivity: float = 0.0) -> TriangleMesh:
    """The surface on which a volume has a given value.

    Vertices are where OpenVDB's dual contouring puts them: one for each sheet of the surface in a cell that it crosses,
    at the mean of the crossings on the cell's edges, which is of second order in the voxel size where the surface is
    smooth. Normals point out of the body: to increasing values, as in a signed distance field, but in a fog volume to
    decreasing ones. Quads are split along their shorter diagonal. A field that does not cross the value gives a mesh
    without faces.

    Args:
        volume: A scalar grid of floating point or quantised values.
        isovalue: Value of the surface, in the grid's units.
        adaptivity: 0 keeps every face; towards 1, flat regions are merged into fewer and larger ones.

    Returns:
        TriangleMesh with the grid's name.

    Raises:
        InputError: The grid is not scalar, isovalue is not finite, or adaptivity is outside [0, 1].
        UnsupportedGridError: A scalar grid without an isosurface: integers, bool, mask.
        MissingDependencyError: geokit was built without OpenVDB.

    Source:
        Ju et al., Dual Contouring of Hermite Data (2002), as in OpenVDB's VolumeToMesh.
    """
    isovalue = _number(isovalue, "isovalue")
    if not np.isfinite(isovalue):
        raise InputError(f"isovalue: {isovalue} is not finite; give a value between the grid's least and greatest")
    adaptivity = _number(adaptivity, "adaptivity")
    if not 0.0 <= adaptivity <= 1.0:
        raise InputError(f"adaptivity: {adaptivity} is outside [0, 1]; 0 keeps every face, 1 merges the most")
    grid_type = volume.info.grid_type
    if isinstance(volume.info.background, tuple) or "index" in grid_type:
        raise InputError(
            f"volume: grid {volume.info.name!r} of type {grid_type} is not scalar and has no isosurface; "
            "use a scalar grid, such as one component of it"
        )
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
    from geokit.volume._nanovdb import aligned_buffer, grid_class_code, grid_header

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
