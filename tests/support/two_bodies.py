"""Two bodies in one level set, and how far the components are from each body alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.volume._components import segment
from tests.support.analytic_volumes import Field, level_set


def cuboid(half: Any, center: Any) -> Field:
    """Signed distance from a box of half edges ``half``, exact on both sides."""

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        beyond = np.abs(points - np.array(center)) - np.array(half)
        # By columns: NumPy reduces rows of three ten times as slowly.
        x, y, z = np.ascontiguousarray(beyond.T)
        outside = np.sqrt(sum(np.maximum(side, 0.0) ** 2 for side in (x, y, z)))
        return outside + np.minimum(np.maximum(np.maximum(x, y), z), 0.0)

    return distance


def directions(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """An axis, a face's and a cell's diagonal, and random unit vectors, (3 + count, 3)."""
    ways = np.concatenate([[[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]], rng.normal(size=(count, 3))])
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))


def errors(bodies: list[Field], *, half_width: float = 3.0, leaves: int = 3, dtype: Any = np.float32) -> list[float]:
    """Largest error [voxels] of each component's values, at all voxels, against its body alone; its band too."""
    whole = level_set(
        lambda p: np.min([d(p) for d in bodies], axis=0), half_width=half_width, leaves=leaves, dtype=dtype
    )
    components = segment(whole, device="cpu")
    assert len(components) == len(bodies)
    steps = np.arange(-8 * leaves, 8 * leaves)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    found = [np.asarray(c.sample(points, order=0, device="cpu")) for c in components]
    worst = []
    for distance in bodies:
        truth = np.clip(distance(points), -half_width, half_width)
        difference = [np.abs(values - truth) for values in found]
        own = int(np.argmin([d.mean() for d in difference]))
        assert components[own].info.background == half_width
        active = np.asarray(components[own].active_at(points, device="cpu"))
        # A voxel is active if its value is below the background.
        np.testing.assert_array_equal(active, np.abs(found[own]) < np.float32(half_width))
        worst.append(float(difference[own].max()))
    return worst
