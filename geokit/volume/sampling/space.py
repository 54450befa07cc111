"""World and index space of query points, and the map between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.require import require_choice
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

SPACES = ("world", "index")


def require_space(space: str) -> None:
    """Check the name of a space.

    Raises:
        InputError: ``space`` is neither "world" nor "index".
    """
    require_choice(space, "space", SPACES)


def world_to_index(volume: SparseVolume, space: str = "world") -> tuple[Any, Any]:
    """Origin (vec3d) and matrix (mat33d) of the map to index coordinates, ``matrix * (point - origin)``."""
    if space == "index":
        return wp.vec3d(0.0, 0.0, 0.0), wp.mat33d(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    def make() -> tuple[Any, Any]:
        transform = volume.info.transform
        to_index = np.linalg.inv(transform[:3, :3])
        return wp.vec3d(*transform[:3, 3].tolist()), wp.mat33d(*to_index.ravel().tolist())

    # The transform of a volume is read-only.
    return volume._cache.find("world to index", make)


def query_inputs(volume: SparseVolume, points: "wp.array", space: str = "world") -> list[Any]:
    """The first inputs of volume kernels: the grid's handle, the points, origin and matrix of world_to_index."""
    return [wp.uint64(volume.id(points.device)), points, *world_to_index(volume, space)]
