"""Derivatives of arrays of warp, and of NumPy for jax: by kernels, and where there are none by NumPy on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from geokit.core.base.query import Query
from geokit.core.gradients.kernel_arrays import pulled_by_kernel
from geokit.core.gradients.library import Library
from geokit.core.gradients.rules import Asked
from geokit.errors import InputError


def pulled(query: Query, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> dict[str, Any]:
    """Derivatives with respect to the arrays ``wanted``, from those with respect to the answer, by name.

    Args:
        query: The query.
        asked: The call, of constants.
        answer: The outputs.
        slopes: Derivatives with respect to the outputs; None where they are 0.
        wanted: Names of tensors.
    Raises:
        InputError: There are more rows than a kernel's sums take.
    """
    rule = query.rule()
    found = pulled_by_kernel(query, asked, answer, slopes, wanted)
    if found is not None:
        return found
    if rule.pull is None:
        raise InputError(f"{', '.join(wanted)}: too many rows for one sum of derivatives; ask in parts")
    asked = asked._replace(tensors={name: _on_host(array).astype(np.float64) for name, array in asked.tensors.items()})
    outputs = [*map(_on_host, answer)]
    given = [
        np.zeros(out.shape) if slope is None else _on_host(slope).astype(np.float64)
        for out, slope in zip(outputs, slopes, strict=True)
    ]
    with np.errstate(all="ignore"):  # of rows that were not found, which do not count
        return rule.pull(_LIBRARY, asked, outputs, given)


def _on_host(array: Any) -> Any:
    """An array of NumPy; a row for each vector."""
    return array.numpy() if isinstance(array, wp.array) else array


# What the rules without a kernel are written with.
_LIBRARY = Library(
    where=np.where,
    sqrt=np.sqrt,
    floor=np.floor,
    stack=np.stack,
    take=lambda table, index: table[index],
    add=lambda rows, index, count: np.bincount(index, rows, minlength=count),
    constant=lambda values, like: np.asarray(values),
    kept=lambda cache, name, values, like: values,
    wide=lambda array: array.astype(np.float64),
    whole=lambda array: array.astype(np.int64),
    detach=lambda array: array,
    ask=lambda query, points, shape, *beside: query(points, *beside),
    # There are first derivatives only.
    once=lambda array, message, of: array,
)
