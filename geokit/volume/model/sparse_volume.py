"""The sparse volume: one NanoVDB grid in a host buffer, its description, and its copies on devices."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.interop.notebook import repr_html, show
from geokit.core.interop.types import Array, Device, Devices, Rows
from geokit.core.memory.needs import needs
from geokit.core.require import described, require_instance
from geokit.errors import InputError
from geokit.volume.nanovdb.checks import mark_checked
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import aligned_buffer, is_aligned

if TYPE_CHECKING:
    from geokit.volume._curvature import Curvatures
    from geokit.volume._dense import DenseGrid
    from geokit.volume._integrate import Transmittance
    from geokit.volume._raycast import VolumeHits
    from geokit.volume.at_points.user_kernels import SparseVolume as InKernels


@dataclass(frozen=True, eq=False)
class SparseVolume:
    """A sparse volume: one NanoVDB grid.

    A pickle or a deep copy carries the buffer, without the copies on devices.

    A grid made on a GPU stays there; ``nanovdb`` downloads it on first access.

    Args:
        nanovdb: The grid's buffer: uint8, C-contiguous, starting at a 32-byte boundary, one grid, no file header.
        info: Its description.
    """

    nanovdb: NDArray[np.uint8]
    info: GridInfo
    _uploads: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    # Holds whether the buffer was checked, its nodes, its box, crossed blocks, and volumes of channels.
    _cache: ClassVar[CacheAttribute] = CacheAttribute()

    def __post_init__(self) -> None:
        buffer = self.nanovdb
        if not isinstance(buffer, np.ndarray) or buffer.dtype != np.uint8 or buffer.ndim != 1:
            raise InputError(f"nanovdb: {described(buffer)} is not an array (N,) of uint8; give the bytes of one grid")
        require_instance(self.info, "info", GridInfo, "take that of another volume, or load the grid from a file")

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Called only for missing attributes: the host buffer of a grid made on a device.
            if name != "nanovdb" or not self.__dict__.get("_uploads"):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            from geokit.volume.nanovdb.upload import download

            object.__setattr__(self, "nanovdb", download(self))
            return self.nanovdb

    @needs()
    def on(self, device: Devices = None) -> "wp.Volume":
        """The grid as a ``warp.Volume`` on ``device``, uploaded once and cached while this volume lives."""
        from geokit.volume.nanovdb.upload import upload

        return upload(self, device)

    @needs()
    def id(self, device: Devices = None) -> int:
        """Handle of the grid for custom kernels: pass it as ``wp.uint64`` and call warp's ``volume_*`` built-ins."""
        return int(self.on(device).id)

    @needs()
    def on_kernel(self, device: Devices = None) -> InKernels:
        """The volume for the user's own kernels, which call :mod:`geokit.kernels` on it, with the calls' bits.

        Unlike :meth:`id` it reads every grid of numbers, quantized ones too, and keeps what it refers to alive.

        Args:
            device: Where the kernels run; None for the first GPU, else the CPU.
        Returns:
            A ``geokit.kernels.SparseVolume``, for a parameter of that type.
        Raises:
            InputError: There is no such device.
            FileFormatError: The buffer is not a valid grid.
            UnsupportedGridError: The grid holds vectors or points.
        """
        from geokit.volume.at_points.sample import on_kernel

        return on_kernel(self, device)

    def sample(
        self,
        points: Rows,
        *,
        order: int | None = None,
        space: str = "world",
        channel: int | str | None = None,
        transform: ArrayLike | None = None,
        device: Devices = None,
    ) -> Array:
        """Values at ``points`` [world] by interpolation of an ``order``; see :func:`geokit.volume.sample`."""
        from geokit.volume.at_points.sample import sample

        return sample(self, points, order=order, space=space, channel=channel, transform=transform, device=device)

    def gradient(
        self,
        points: Rows,
        *,
        order: int | None = None,
        space: str = "world",
        channel: int | str | None = None,
        transform: ArrayLike | None = None,
        device: Devices = None,
    ) -> Array:
        """Gradients [value / world] at ``points`` [world]; see :func:`geokit.volume.gradient`."""
        from geokit.volume.at_points.sample import gradient

        return gradient(self, points, order=order, space=space, channel=channel, transform=transform, device=device)

    def hessian(self, points: Rows, *, order: int = 3, space: str = "world", device: Devices = None) -> Array:
        """Second derivatives [value / world^2] at ``points`` [world]; see :func:`geokit.volume.hessian`."""
        from geokit.volume._curvature import hessian

        return hessian(self, points, order=order, space=space, device=device)

    def curvature(self, points: Rows, *, order: int = 3, device: Devices = None) -> Curvatures:
        """Curvatures [1 / world] of the level sets through ``points`` [world]; see :func:`geokit.volume.curvature`."""
        from geokit.volume._curvature import curvature

        return curvature(self, points, order=order, device=device)

    def active_at(self, points: Rows, *, space: str = "world", device: Devices = None) -> Array:
        """Whether the voxel around each of ``points`` [world] is active; see :func:`geokit.volume.active_at`."""
        from geokit.volume.at_points.active import active_at

        return active_at(self, points, space=space, device=device)

    def quantize(
        self, codec: str | None = None, *, tolerance: float | None = None, dither: bool = False
    ) -> SparseVolume:
        """The volume in fewer bits a voxel, by a ``codec`` or within a ``tolerance`` [value].

        Arguments and errors are those of :func:`geokit.volume.quantize`.
        """
        from geokit.volume.retyped.quantize import quantize

        return quantize(self, codec, tolerance=tolerance, dither=dither)

    def to_dense(
        self,
        *,
        bounds: ArrayLike | None = None,
        dtype: DTypeLike | None = None,
        channel: int | str | None = None,
        device: Device = None,
    ) -> DenseGrid:
        """All voxels of a box as an array, ``bounds`` being its first and last voxel [index].

        Arguments and errors are those of :func:`geokit.volume.to_dense`.
        """
        from geokit.volume._dense import to_dense

        return to_dense(self, bounds=bounds, dtype=dtype, channel=channel, device=device)

    def raycast(
        self,
        origins: Rows,
        directions: Rows,
        *,
        isovalue: float = 0.0,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        transform: ArrayLike | None = None,
        device: Devices = None,
    ) -> VolumeHits:
        """The first point of each ray where the value is ``isovalue``, within ``max_distance`` [world].

        Arguments and errors are those of :func:`geokit.volume.raycast`.
        """
        from geokit.volume._raycast import raycast

        limits = {"isovalue": isovalue, "t_min": t_min, "max_distance": max_distance}
        return raycast(self, origins, directions, **limits, transform=transform, device=device)

    def integrate(
        self,
        origins: Rows,
        directions: Rows,
        *,
        extinction: float = 1.0,
        emission: SparseVolume | None = None,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        device: Devices = None,
    ) -> Transmittance:
        """Transmittance and emission along rays up to ``max_distance`` [world]; see :func:`geokit.volume.integrate`."""
        from geokit.volume._integrate import integrate

        limits = {"t_min": t_min, "max_distance": max_distance}
        return integrate(self, origins, directions, extinction=extinction, emission=emission, **limits, device=device)

    def __reduce__(self) -> Any:
        return _restored, (self.nanovdb, self.info)

    _repr_html_ = repr_html
    show = show

    def __repr__(self) -> str:
        size = " x ".join(f"{s:.6g}" for s in self.info.voxel_size)
        return (
            f"SparseVolume({self.info.name!r}, {self.info.grid_type}, {self.info.grid_class}, "
            f"{self.info.active_voxel_count} active voxels of {size})"
        )


def _restored(nanovdb: NDArray[np.uint8], info: GridInfo) -> SparseVolume:
    """A volume from a pickle, which keeps no alignment."""
    buffer = nanovdb
    if not is_aligned(nanovdb):
        buffer = aligned_buffer(len(nanovdb))
        buffer[:] = nanovdb
    return SparseVolume(buffer, info)


def made_on_device(grid: "wp.array", info: GridInfo) -> SparseVolume:
    """A volume whose grid a kernel has built on a device; its host buffer is downloaded on first access.

    Args:
        grid: The grid's bytes, uint8, on a GPU.
        info: Its description.
    """
    from geokit.volume.nanovdb.grid_array import made_volume

    volume = SparseVolume.__new__(SparseVolume)
    made: Any = made_volume(grid, info.byte_count)
    made._geokit_source = grid  # it does not own its memory
    uploads = {grid.device.alias: (made, grid, None)}
    for name, value in (("info", info), ("_uploads", uploads)):
        object.__setattr__(volume, name, value)
    mark_checked(volume)  # as it was built
    return volume
