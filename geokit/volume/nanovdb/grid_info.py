"""The description of a grid: type, class, transform, bounds, metadata."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.provenance import ACHIEVED_999, ACHIEVED_ERROR, ORDER, TOLERANCE, known_number, world_of


@dataclass(frozen=True, eq=False)
class GridInfo:
    """Description of a grid that is known without reading its voxels.

    Attributes:
        name: The grid's name, ``""`` if it has none.
        grid_type: Value type, as NanoVDB names it in lower case: "float", "double", "int32", "int64", "vec3f",
            "vec3d", "vec3i", "bool", "mask", "half", "fp4", "fp8", "fp16", "fpn", ...
        grid_class: "level set", "fog volume", "staggered", "point index", "point data", "topology", "unknown", ...
        transform: Index to world, shape (4, 4) float64: ``world = transform[:3, :3] @ index + transform[:3, 3]``.
        voxel_size: Edge lengths of a voxel along its index axes [world], shape (3,).
        background: Value outside all nodes: a float, int, bool or a tuple of them.
        active_voxel_count: Number of active voxels, including those of active tiles; None if a file's header does not
            state it.
        index_bounds: First and last active voxel, shape (2, 3) int64, both inclusive; None if no voxel is active.
        byte_count: Size of the NanoVDB buffer, or of the grid in its file if only its header was read.
        metadata: The OpenVDB metadata of the grid (strings, numbers, tuples, bytes), read-only; those of its .vdb file
            have "geokit:file:" before their names.
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
    metadata: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "metadata": dict(self.metadata)}  # a read-only view cannot be pickled

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, metadata=MappingProxyType(state["metadata"]))

    @property
    def world_bounds(self) -> NDArray[np.float64] | None:
        """Box around the active voxel centers [world], shape (2, 3); None if no voxel is active."""
        if self.index_bounds is None:
            return None
        corners = np.array(np.meshgrid(*self.index_bounds.T, indexing="ij"), dtype=np.float64).reshape(3, -1)
        world = self.transform[:3, :3] @ corners + self.transform[:3, 3:]
        return np.stack([world.min(axis=1), world.max(axis=1)])

    @property
    def meters_per_unit(self) -> float | None:
        """Length of the world's unit [m]; None where it is not known."""
        return world_of(self.metadata)[0]

    @property
    def up_axis(self) -> str | None:
        """The axis of the world that points up, "x", "y" or "z"; None where it is not known."""
        return world_of(self.metadata)[1]

    @property
    def tolerance(self) -> float | None:
        """Error that was requested when the values were made [value units], or None if none was."""
        return known_number(self.metadata.get(TOLERANCE))

    @property
    def achieved_error(self) -> float | None:
        """Largest error that was then found [value units], of voxels or of interpolated distances; None if unknown."""
        return known_number(self.metadata.get(ACHIEVED_ERROR))

    @property
    def achieved_error_999(self) -> float | None:
        """99.9th percentile of the interpolated distances' errors [value units], or None if unknown."""
        return known_number(self.metadata.get(ACHIEVED_999))

    @property
    def order(self) -> int | None:
        """Order of interpolation for which the values were made, or None if none was chosen."""
        order = known_number(self.metadata.get(ORDER))
        return int(order) if order in (1.0, 2.0, 3.0) else None
