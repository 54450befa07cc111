"""A sparse volume: one NanoVDB grid in a host buffer, its description, and its copies on devices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume._provenance import ACHIEVED_999, ACHIEVED_ERROR, ORDER, TOLERANCE, known_number

if TYPE_CHECKING:
    import warp as wp

    from geokit.volume.curvature import Curvatures
    from geokit.volume.dense import DenseGrid
    from geokit.volume.integrate import Transmittance
    from geokit.volume.raycast import VolumeHits

__all__ = ["GridInfo", "SparseVolume"]


@dataclass(frozen=True, eq=False)
class GridInfo:
    """What is known about a grid without reading its voxels.

    Attributes:
        name: The grid's name, ``""`` where it has none.
        grid_type: Value type, as NanoVDB names it in lower case: "float", "double", "int32", "int64", "vec3f",
            "vec3d", "vec3i", "bool", "mask", "half", "fp4", "fp8", "fp16", "fpn", ...
        grid_class: "level set", "fog volume", "staggered", "point index", "point data", "topology", "unknown", ...
        transform: Index to world, shape (4, 4) float64: ``world = transform[:3, :3] @ index + transform[:3, 3]``.
        voxel_size: Edge lengths of a voxel along its index axes [world], shape (3,).
        background: Value outside every node; a float, int, bool or a tuple of them.
        active_voxel_count: Number of active voxels, those of active tiles included; None where a file's header does
            not say.
        index_bounds: First and last active voxel, shape (2, 3) int64, both inclusive; None where none is active.
        byte_count: Size of the NanoVDB buffer, or of the grid in its file where only its header was read.
        metadata: The OpenVDB metadata of the grid (strings, numbers, tuples, bytes), read-only.
    """

    name: str
    grid_type: str
    grid_class: str
    transform: NDArray[np.float64]
    voxel_size: NDArray[np.float64]
    background: Any
    active_voxel_count: int | None
    index_bounds: NDArray[np.int64] | None
    byte_count: int
    metadata: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def world_bounds(self) -> NDArray[np.float64] | None:
        """Box around the active voxel centres [world], shape (2, 3); None where none is active."""
        if self.index_bounds is None:
            return None
        corners = np.array(np.meshgrid(*self.index_bounds.T, indexing="ij"), dtype=np.float64).reshape(3, -1)
        world = self.transform[:3, :3] @ corners + self.transform[:3, 3:]
        return np.stack([world.min(axis=1), world.max(axis=1)])

    @property
    def tolerance(self) -> float | None:
        """Error that was asked for when the values were made [value units]; None where none was."""
        return known_number(self.metadata.get(TOLERANCE))

    @property
    def achieved_error(self) -> float | None:
        """Largest error that was found then [value units]: of voxels, or of interpolated distances; None if unknown."""
        return known_number(self.metadata.get(ACHIEVED_ERROR))

    @property
    def achieved_error_999(self) -> float | None:
        """99.9th percentile of the interpolated distances' errors [value units]; None if unknown."""
        return known_number(self.metadata.get(ACHIEVED_999))

    @property
    def order(self) -> int | None:
        """Order of interpolation for which the values were made; None where none was chosen."""
        order = known_number(self.metadata.get(ORDER))
        return int(order) if order in (1.0, 2.0, 3.0) else None


@dataclass(frozen=True, eq=False)
class SparseVolume:
    """One NanoVDB grid.

    A grid that was made on a GPU stays there; ``nanovdb`` fetches it when it is first asked for.

    Args:
        nanovdb: The grid's buffer: uint8, C-contiguous, starting at a 32-byte boundary, one grid, no file header.
        info: Its description.
    """

    nanovdb: NDArray[np.uint8]
    info: GridInfo
    _uploads: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Only asked for what is not there: the host buffer of a grid that was made on a device.
            if name != "nanovdb" or not self.__dict__.get("_uploads"):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            from geokit.volume._upload import download

            object.__setattr__(self, "nanovdb", download(self))
            return self.nanovdb

    def on(self, device: Any = None) -> "wp.Volume":
        """The grid as a ``warp.Volume`` on ``device``, uploaded once and kept while this volume lives."""
        from geokit.volume._upload import upload

        return upload(self, device)

    def id(self, device: Any = None) -> int:
        """Handle for the user's own kernels: pass it as ``wp.uint64`` and call warp's ``volume_*`` built-ins."""
        return int(self.on(device).id)

    def sample(
        self,
        points: Any,
        *,
        order: int | None = None,
        space: str = "world",
        channel: int | str | None = None,
        device: Any = None,
    ) -> Any:
        """See :func:`geokit.volume.sample`."""
        from geokit.volume.sample import sample

        return sample(self, points, order=order, space=space, channel=channel, device=device)

    def gradient(
        self,
        points: Any,
        *,
        order: int | None = None,
        space: str = "world",
        channel: int | str | None = None,
        device: Any = None,
    ) -> Any:
        """See :func:`geokit.volume.gradient`."""
        from geokit.volume.sample import gradient

        return gradient(self, points, order=order, space=space, channel=channel, device=device)

    def hessian(self, points: Any, *, order: int = 3, space: str = "world", device: Any = None) -> Any:
        """See :func:`geokit.volume.hessian`."""
        from geokit.volume.curvature import hessian

        return hessian(self, points, order=order, space=space, device=device)

    def curvature(self, points: Any, *, order: int = 3, device: Any = None) -> Curvatures:
        """See :func:`geokit.volume.curvature`."""
        from geokit.volume.curvature import curvature

        return curvature(self, points, order=order, device=device)

    def active_at(self, points: Any, *, space: str = "world", device: Any = None) -> Any:
        """See :func:`geokit.volume.active_at`."""
        from geokit.volume.active import active_at

        return active_at(self, points, space=space, device=device)

    def quantize(
        self, codec: str | None = None, *, tolerance: float | None = None, dither: bool = False
    ) -> SparseVolume:
        """See :func:`geokit.volume.quantize`."""
        from geokit.volume.quantize import quantize

        return quantize(self, codec, tolerance=tolerance, dither=dither)

    def to_dense(
        self, *, bounds: Any = None, dtype: Any = None, channel: int | str | None = None, device: Any = None
    ) -> DenseGrid:
        """See :func:`geokit.volume.to_dense`."""
        from geokit.volume.dense import to_dense

        return to_dense(self, bounds=bounds, dtype=dtype, channel=channel, device=device)

    def raycast(
        self,
        origins: Any,
        directions: Any,
        *,
        isovalue: float = 0.0,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        device: Any = None,
    ) -> VolumeHits:
        """See :func:`geokit.volume.raycast`."""
        from geokit.volume.raycast import raycast

        limits = {"isovalue": isovalue, "t_min": t_min, "max_distance": max_distance}
        return raycast(self, origins, directions, **limits, device=device)

    def integrate(
        self,
        origins: Any,
        directions: Any,
        *,
        extinction: float = 1.0,
        emission: SparseVolume | None = None,
        t_min: float = 0.0,
        max_distance: float = math.inf,
        device: Any = None,
    ) -> Transmittance:
        """See :func:`geokit.volume.integrate`."""
        from geokit.volume.integrate import integrate

        limits = {"t_min": t_min, "max_distance": max_distance}
        return integrate(self, origins, directions, extinction=extinction, emission=emission, **limits, device=device)

    def __repr__(self) -> str:
        size = " x ".join(f"{s:.6g}" for s in self.info.voxel_size)
        return (
            f"SparseVolume({self.info.name!r}, {self.info.grid_type}, {self.info.grid_class}, "
            f"{self.info.active_voxel_count} active voxels of {size})"
        )
