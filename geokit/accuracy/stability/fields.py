"""Fields with known values on voxels of size 1 around the origin, and rays, for the sweeps of volumes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.trials.model import Judgement
from geokit.accuracy.trials.running import unit

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

Floats = NDArray[np.float64]
Field = Callable[[Floats], Floats]

# Center of a body [voxels]: neither on a voxel nor on a plane of symmetry of the voxels.
MIDDLE = np.array([0.13, 0.27, 0.41])
# Voxels stored beyond a body: more than the widest band that is queried.
MARGIN = 6


def unit_vectors(count: int, seed: int | np.random.Generator) -> Floats:
    """Random unit vectors, uniform on the sphere, shape (count, 3)."""
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def joined(ask: Callable[..., Iterator[Judgement]]) -> Callable[..., Judgement]:
    """Decorator of a function that asks about several things, one after the other: what it yields, as one judgement."""

    @wraps(ask)
    def run(*given: Any, **options: Any) -> Judgement:
        return Judgement(*(np.concatenate(parts) for parts in zip(*ask(*given, **options), strict=True)))

    return run


def ball(radius: float, center: Floats = MIDDLE) -> Field:
    """Signed distance from a sphere [voxels]."""
    return lambda points: np.linalg.norm(points - center, axis=-1) - radius


def voxel_centers(reach: int) -> Floats:
    """All voxel centers with coordinates from -reach to reach, shape (n, n, n, 3)."""
    axis = np.arange(-reach, reach + 1.0)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def level_set(function: Field, reach: float, cut: float = 3.0) -> SparseVolume:
    """A function clipped to +-cut, on the voxels up to MARGIN beyond ``reach``; farther out it is ``cut``."""
    from geokit.volume._dense import from_dense

    corner = int(np.ceil(reach)) + MARGIN
    values = np.clip(function(voxel_centers(corner)), -cut, cut)
    return from_dense(values, voxel_size=1.0, origin=3 * (-corner,), background=cut, grid_class="level set")


def field(function: Field, reach: int, *, background: float = 0.0, transform: Any = None) -> SparseVolume:
    """A function of the index on all voxels from -reach to reach, all of them stored."""
    from geokit.volume._dense import from_dense

    matrix = np.eye(4) if transform is None else transform
    values = function(voxel_centers(reach))
    return from_dense(values, transform=matrix, origin=3 * (-reach,), background=background)
