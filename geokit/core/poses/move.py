"""Rigid maps, and rows of points and directions moved by them in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.interop import user_arrays
from geokit.core.require import read_array, require_affine
from geokit.errors import InputError

__all__ = ["BYTES_PER_MOVE", "move", "move_packed", "require_rigid", "require_rigid_maps"]

# How far axes may be from orthonormal: poses in float32 are off by 1e-7, and distances are off by no larger share.
RIGID = 1e-6
# Memory of a moved row.
BYTES_PER_MOVE = 24


def require_rigid(transform: Any) -> NDArray[np.float64]:
    """A rigid map for column vectors, (4, 4), as float64.

    Raises:
        InputError: It has another shape or last row, a number that is not finite, or is not rigid.
    """
    matrix = require_affine(transform, "transform")
    _require_orthonormal(matrix[None], "")
    return matrix


def require_rigid_maps(transforms: Any, count: int) -> NDArray[np.float64]:
    """A rigid map for each of ``count`` bodies, (count, 4, 4), as float64.

    Raises:
        InputError: The shape is another one, or a map is not as :func:`require_rigid` says; the message names it.
    """
    maps: NDArray[np.float64] = read_array(transforms, "transform", np.float64)
    if maps.shape != (count, 4, 4):
        raise InputError(f"transform: shape {maps.shape} is not ({count}, 4, 4); give a map for each mesh")
    bad = ~np.isfinite(maps).all(axis=(1, 2)) | (maps[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"transform: map {row} is {maps[row].tolist()}; give finite numbers, and 0, 0, 0, 1 in the last row"
        )
    _require_orthonormal(maps, "map {} is ")
    return maps


def _require_orthonormal(maps: NDArray[np.float64], named: str) -> None:
    linear = maps[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        bad = ~(np.abs(linear.transpose(0, 2, 1) @ linear - np.eye(3)).max(axis=(1, 2)) <= RIGID)
    if bad.any():
        raise InputError(
            f"transform: {named.format(int(np.argmax(bad)))}not a rigid motion, as its axes are not of length 1 and at "
            "right angles; move the mesh by geokit.mesh.transform instead"
        )


def move(rows: Any, matrix: NDArray[np.float64], *, turned: bool = False) -> Any:
    """Rows on a device where the map places them; ``turned`` only, for directions."""
    import warp as wp

    from geokit.core.poses.move_kernels import move_kernel

    shift = np.zeros(3) if turned else matrix[:3, 3]
    out = wp.empty(len(rows), dtype=wp.vec3d, device=rows.device)
    inputs = [rows, wp.mat33d(*matrix[:3, :3].ravel().tolist()), wp.vec3d(*shift.tolist())]
    launcher.launch(move_kernel, len(rows), inputs, [out], rows.device)
    return out


def move_packed(rows: Any, offsets: Any, maps: NDArray[np.float64], *, turned: bool = False) -> Any:
    """As :func:`move`, in the kind of memory of ``rows``; map m moves the rows from ``offsets[m]`` on."""
    import warp as wp

    from geokit.core.poses.move_kernels import move_packed_kernel

    device = rows.device
    linear, shift = np.ascontiguousarray(maps[:, :3, :3]), np.ascontiguousarray(maps[:, :3, 3])
    if turned:
        shift = np.zeros_like(shift)
    inputs = [
        offsets,
        rows,
        wp.array(linear, dtype=wp.mat33d, device=device),
        wp.array(shift, dtype=wp.vec3d, device=device),
    ]
    out = user_arrays.empty(len(rows), wp.vec3d, rows)
    launcher.launch(move_packed_kernel, len(rows), inputs, [out], device)
    return out
