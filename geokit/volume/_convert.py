"""Volumes for other libraries, as dense arrays with their place in the world; each library is imported when needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit._packages import require_package
from geokit.core.interop.types import Device
from geokit.core.memory.needs import needs
from geokit.errors import InputError, MissingDependencyError
from geokit.volume._dense import native_of, to_dense
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    import pyvista
    import xarray

    from geokit.volume.model.sparse_volume import SparseVolume

# Axes are at right angles where the cosine between them is at most this.
LARGEST_COSINE = 1e-9


def _image_bytes(volume: SparseVolume, bounds: Any = None, **_: Any) -> float:
    """Of the dense array, and of its copy in the order of images."""
    box = volume.info.index_bounds if bounds is None else np.asarray(bounds)
    native, components = native_of(volume)
    return 0.0 if box is None else 2.0 * components * native.itemsize * float((box[1] - box[0] + 1).prod(dtype=float))


@needs(_image_bytes, fatal=True)
def to_pyvista(volume: SparseVolume, *, bounds: ArrayLike | None = None, device: Device = None) -> pyvista.ImageData:
    """A ``pyvista.ImageData`` of the voxels of a box, as its active point data; :func:`from_dense` takes it back.

    Voxels become points of the image, and ``offset`` is the index of the first one, so that indices are kept.

    Args:
        volume: A grid of any scalar, vector or color type.
        bounds: First and last voxel [index], shape (2, 3), both inclusive; None for the box around the active voxels.
        device: Device that reads the voxels; None for the first GPU, else the CPU.
    Returns:
        pyvista.ImageData; the array has the grid's name, or "value".
    Raises:
        InputError: bounds is no box of voxels, there are none, or the voxels are sheared, or their squared edges leave
            float64.
        UnsupportedGridError: The grid stores no values of its own.
        DeviceMemoryError: The array does not fit into memory.
        MissingDependencyError: PyVista is not installed.
    """
    dense = _dense(volume, bounds, device)
    linear = dense.transform[:3, :3]
    with np.errstate(over="ignore", under="ignore"):
        spacing = np.linalg.norm(linear, axis=0)
    if not (spacing > 0.0).all() or not np.isfinite(spacing).all():
        raise InputError("volume: edges of its voxels leave the range of images; use volume.resample")
    direction = linear / spacing
    if np.abs(direction.T @ direction - np.eye(3)).max() > LARGEST_COSINE:
        raise InputError("volume: its voxels are sheared, and images have right angles; use volume.resample")
    pyvista = require_package("pyvista")
    image = pyvista.ImageData(dimensions=dense.values.shape[:3], spacing=spacing, origin=dense.transform[:3, 3])
    image.direction_matrix = direction
    image.offset = dense.origin
    name = volume.info.name or "value"
    count = int(np.prod(dense.values.shape[:3]))
    rows = (
        dense.values.reshape(count, order="F")
        if dense.values.ndim == 3
        else np.stack([dense.values[..., at].reshape(count, order="F") for at in range(dense.values.shape[3])], axis=1)
    )
    image.point_data[name] = rows
    image.set_active_scalars(name)
    return image


@needs()
def to_xarray(volume: SparseVolume, *, bounds: ArrayLike | None = None, device: Device = None) -> xarray.DataArray:
    """An ``xarray.DataArray`` of the voxels of a box; :func:`from_dense` takes it back.

    The coordinates along x, y and z are those of the voxel centers [world]. Where the voxels are not aligned with the
    axes of the world, they are voxel indices, and ``attrs["transform"]`` holds the transform from index to world, row
    by row.

    Args:
        volume: A grid of any scalar, vector or color type.
        bounds: First and last voxel [index], shape (2, 3), both inclusive; None for the box around the active voxels.
        device: Device that reads the voxels; None for the first GPU, else the CPU.
    Returns:
        xarray.DataArray with dims x, y and z, and "component" for vectors, and the grid's name and class.
    Raises:
        InputError: bounds is no box of voxels, or there are none.
        UnsupportedGridError: The grid stores no values of its own.
        DeviceMemoryError: The array does not fit into memory.
        MissingDependencyError: xarray is not installed.
    """
    dense = _dense(volume, bounds, device)
    try:
        import xarray
    except ImportError:
        remedy = "install it with: pip install xarray"
        raise MissingDependencyError(f"to_xarray needs the package xarray; {remedy}") from None
    coordinates, attributes = axes_of(dense.transform, dense.origin, dense.values.shape)
    attributes["grid_class"] = volume.info.grid_class
    dims = ["x", "y", "z", "component"][: dense.values.ndim]
    axes = dict(zip("xyz", coordinates, strict=True))
    return xarray.DataArray(dense.values, coords=axes, dims=dims, name=volume.info.name or None, attrs=attributes)


def axes_of(
    transform: NDArray[np.float64], origin: Any, shape: tuple[int, ...]
) -> tuple[list[NDArray[Any]], dict[str, Any]]:
    """Coordinates along x, y and z of a box of voxels, and the attributes that they need, as of :func:`to_xarray`.

    Args:
        transform: Index to world, (4, 4).
        origin: Index of the first voxel.
        shape: Number of voxels along each axis; further numbers are left out.
    """
    indices = [int(start) + np.arange(size) for start, size in zip(origin, shape, strict=False)]
    steps, shift = np.diag(transform)[:3], transform[:3, 3]
    if not np.array_equal(np.diag(steps), transform[:3, :3]):
        return indices, {"transform": transform.ravel()}
    return [at * step + first for at, step, first in zip(indices, steps, shift, strict=True)], {}


def _dense(volume: SparseVolume, bounds: Any, device: Any) -> Any:
    require_volume(volume, "volume")
    dense = to_dense(volume, bounds=bounds, device=device)
    if not dense.values.size:
        raise InputError(f"volume: grid {volume.info.name!r} has no active voxel; give bounds")
    return dense
