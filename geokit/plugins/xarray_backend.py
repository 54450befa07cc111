"""Volumes as files of xarray: ``xarray.open_dataset("smoke.vdb")``, which finds this module by its entry point."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from xarray import Dataset, Variable
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from geokit.core.files import extension
from geokit.errors import GeokitError
from geokit.formats.table import SPARSE
from geokit.plugins._grids import MOST_BYTES, require_fits

AXES = ("x", "y", "z")
# Of vectors, by how many numbers they have; a data set has one size for each dimension.
COMPONENTS = {3: "component", 4: "component4"}
# A box of no voxels.
NOTHING = np.array([[0, 0, 0], [-1, -1, -1]])


class VolumeBackend(BackendEntrypoint):
    """xarray's engine ``geokit``, for .vdb and .nvdb files."""

    description = "Sparse volumes of OpenVDB and NanoVDB (.vdb, .nvdb)"

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        most_bytes: int = MOST_BYTES,
        device: Any = None,
    ) -> Dataset:
        """The grids of a file as variables.

        The sparse grids are read at once. A dense array is made when values are asked for, of the box that is asked
        for: ``dataset["density"][100:200].values``, or ``chunks={}`` with dask.

        Grids with one transform share the dimensions x, y and z, over the box around the active voxels of all of them.
        Those of a further transform have dimensions of their own, such as ``x_velocity``, after the first of them.
        Coordinates and attributes are those of :func:`geokit.volume.to_xarray`.

        Args:
            filename_or_obj: The file.
            drop_variables: Names of grids that are not read.
            most_bytes: Largest array that is made at a time [bytes].
            device: Device that reads the voxels; None for the first GPU, else the CPU.
        Returns:
            xarray.Dataset; a grid without a name is "value", and one that has the name of a dimension is "x[1]".
        Raises:
            InputError: The extension is neither.
            FileAccessError, FileFormatError: The file is missing or damaged.
            UnsupportedGridError: A grid stores no values; drop_variables leaves it out.
        """
        from geokit.volume._convert import axes_of
        from geokit.volume._dense import native_of

        volumes = _read(filename_or_obj, drop_variables)
        alike: dict[bytes, list[str]] = {}
        for name, volume in volumes.items():
            alike.setdefault((volume.info.transform + 0.0).tobytes(), []).append(name)  # no zero with a sign
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {}
        for names in alike.values():
            suffix = f"_{names[0]}" if variables else ""
            boxes = [box for name in names if (box := volumes[name].info.index_bounds) is not None] or [NOTHING]
            first, last = np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]
            dims = [axis + suffix for axis in AXES]
            shape = tuple(int(n) for n in last - first + 1)
            where, placed = axes_of(volumes[names[0]].info.transform, first, shape)
            coordinates.update({dim: (dim, at) for dim, at in zip(dims, where, strict=True)})
            for name in names:
                volume = volumes[name]
                dtype, components = native_of(volume)
                values = _Voxels(
                    volume=volume,
                    origin=first,
                    shape=shape if components == 1 else (*shape, components),
                    dtype=dtype,
                    path=filename_or_obj,
                    most_bytes=most_bytes,
                    device=device,
                )
                own = [*dims, *([COMPONENTS[components]] if components > 1 else [])]
                attributes = {**placed, "grid_class": volume.info.grid_class}
                variables[name] = Variable(own, indexing.LazilyIndexedArray(values), attributes)
        return Dataset(variables, coords=coordinates)

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Whether the file's name says that it holds volumes."""
        try:
            return extension(filename_or_obj) in SPARSE
        except GeokitError:
            return False


class _Voxels(BackendArray):
    """The voxels of a box, read when they are asked for."""

    def __init__(
        self, *, volume: Any, origin: Any, shape: tuple[int, ...], dtype: Any, path: Any, most_bytes: int, device: Any
    ) -> None:
        self.shape = shape
        self.dtype = dtype
        self._volume, self._origin = volume, origin
        self._path, self._most_bytes, self._device = path, most_bytes, device

    def __getitem__(self, key: Any) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        """Values of a key of indices and slices that step forward."""
        from geokit.volume._dense import to_dense

        rows = [np.arange(size)[part] for size, part in zip(self.shape, key, strict=True)]
        if not all(np.size(row) for row in rows):
            return np.broadcast_to(np.zeros((), self.dtype), self.shape)[key]
        first, last = ([int(np.ravel(row)[end]) for row in rows[:3]] for end in (0, -1))
        box = self._origin + np.array([first, last])
        require_fits(self._volume, self._path, self._most_bytes, box=box, remedy="ask for a part")
        values = to_dense(self._volume, bounds=box, device=self._device).values
        inside = tuple(slice(None, None, part.step) if isinstance(part, slice) else 0 for part in key[:3])
        return values[inside + key[3:]]


def _read(path: str | os.PathLike[str], drop_variables: str | Iterable[str] | None) -> dict[str, Any]:
    """Grids by the names of their variables."""
    from geokit.volume._io import inspect, load, load_all, unique_names
    from geokit.volume.nanovdb.types import INDEX_TYPES
    from geokit.volume.retyped.from_channel import from_channel

    dropped = {drop_variables} if isinstance(drop_variables, str) else set(drop_variables or ())
    if dropped:
        grids = unique_names([info.name for info in inspect(path)])
        volumes = {
            name: load(path, grid=grid)
            for name, grid in zip(_variables(grids), grids, strict=True)
            if name not in dropped
        }
    else:
        loaded = load_all(path)
        volumes = dict(zip(_variables(list(loaded)), loaded.values(), strict=True))
    return {
        name: from_channel(volume, 0) if volume.info.grid_type in INDEX_TYPES else volume
        for name, volume in volumes.items()
    }


def _variables(grids: list[str]) -> list[str]:
    """Names of variables, none that of a dimension."""
    from geokit.volume._io import unique_names

    dims = [*AXES, *COMPONENTS.values()]
    return unique_names([*dims, *(name or "value" for name in grids)])[len(dims) :]
