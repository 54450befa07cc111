"""Volumes whose active values are an array of jax: samples and hits carry gradients with respect to them."""

from __future__ import annotations

from typing import NoReturn

import jax
import numpy as np
from numpy.typing import NDArray

from geokit import volume as verbs
from geokit.core.gradients.rules import hold
from geokit.core.gradients.with_jax import Traced
from geokit.core.interop.types import Rows
from geokit.errors import InputError
from geokit.jax._surface import read_jax

__all__ = ["Volume", "with_values"]


class Volume(Traced):
    """Result of :func:`with_values`. ``sample``, ``gradient``, ``raycast`` and ``integrate`` take it, also as methods.

    Attributes:
        template: The volume whose tree, transform and constant values it has.
        info: What is known of the template.
    """

    sample = verbs.sample
    gradient = verbs.gradient
    raycast = verbs.raycast
    integrate = verbs.integrate

    def __init__(self, template: verbs.SparseVolume, values: jax.Array | np.ndarray) -> None:
        self.template, self.info = template, template.info
        self._kept: dict[str, tuple[NDArray[np.floating], verbs.SparseVolume]] = {}
        hold(self, values=values)

    def hessian(self, points: Rows, **_: object) -> NoReturn:
        """Second derivatives of samples are not known here.

        Raises:
            InputError: Always.
        """
        raise InputError("order: gradients of order 2 and 3 have no derivative in jax; take order 1, or torch")

    def made(self, **arrays: NDArray[np.floating]) -> verbs.SparseVolume:
        """The volume of known values; see :class:`geokit.core.gradients.rules.Deferred`."""
        values = arrays["values"]
        kept = self._kept.get("volume")
        if kept is None or not np.array_equal(kept[0], values):
            kept = self._kept["volume"] = values.copy(), verbs.with_values(self.template, values)
        return kept[1]


def with_values(volume: verbs.SparseVolume, values: jax.Array | np.ndarray) -> Volume:
    """The same voxels with active values that are an array of jax: :func:`geokit.volume.with_values` with gradients.

    Samples of orders 1 to 3, gradients of order 1, hits, transmittances and emissions carry gradients with respect to
    points or rays and to the values, under ``jax.grad``, ``jax.jit`` and ``jax.vmap`` (also over values).

    Args:
        volume: A float or double grid.
        values: One value for each row of :func:`geokit.volume.active_voxels`, an array (A,) of jax (or NumPy).
    Returns:
        A Volume.
    Raises:
        InputError: ``values`` is no array, or not (A,) of float32 or float64.
        UnsupportedGridError: The grid is neither float nor double.
        FileFormatError: The buffer is not a valid grid.
    """
    values = read_jax(values, "values")
    count = len(verbs.active_voxels(volume).values)
    if tuple(values.shape) != (count,):
        raise InputError(f"values: shape {tuple(values.shape)} is not ({count},); give one for each active voxel")
    return Volume(volume, values)
