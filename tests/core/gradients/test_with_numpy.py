"""Derivatives that are followed through NumPy, against differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from geokit.core.gradients.library import cross, dot, length
from geokit.core.gradients.with_numpy import LIBRARY, Followed, plain, pulled_back

INDEX = np.array([[0, 2], [2, 1], [0, 0]])
OTHER = np.random.default_rng(1).random((3, 1)) + 0.5
# Each of tables (3, 3) of numbers between 0.5 and 1.5.
EXPRESSIONS: dict[str, Callable[[Any, Any], Any]] = {
    "sums": lambda a, b: a + b - 2.0 + (OTHER - a) + (1.0 + b),
    "products": lambda a, b: a * b * 3.0 + OTHER * a - (-b),
    "quotients": lambda a, b: a / b + 1.0 / a + OTHER / b + b / 4.0,
    "powers": lambda a, b: a**3 + b**0.5,
    "broadcast": lambda a, b: a[:, None] * b[None] + a[..., 0] * b[0],
    "shapes": lambda a, b: a.reshape(9) * b.reshape(-1) + (a.sum(1)[:, None] * b).reshape(9),
    "means": lambda a, b: a.mean() * b + b[int(plain(b[:, 0]).argmax())],
    "where": lambda a, b: LIBRARY.where(a > b, a * 2.0, LIBRARY.where(b >= 1.0, 1.0, b * b)),
    "roots": lambda a, b: LIBRARY.sqrt(a) + LIBRARY.arctan2(a - 1.0, b - 1.0),
    "stacks": lambda a, b: LIBRARY.stack([a[..., 0], b[..., 1], OTHER[:, 0]], -1),
    "tables": lambda a, b: LIBRARY.take(a, INDEX) * LIBRARY.take(b, INDEX[::-1]),
    "sums of rows": lambda a, b: LIBRARY.add(LIBRARY.take(a, INDEX) * b[:, None], INDEX, 4),
    "vectors": lambda a, b: cross(LIBRARY, a, b) * dot(a, b)[:, None] + length(LIBRARY, a - b)[:, None],
    "one twice": lambda a, b: (a * a - a) * (b / b),
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_expressions(name: str) -> None:
    random = np.random.default_rng(2)
    tables = [random.random((3, 3)) + 0.5 for _ in range(2)]
    ways = [random.standard_normal((3, 3)) for _ in range(2)]
    followed = [Followed(table) for table in tables]
    answer = EXPRESSIONS[name](*followed)
    slope = random.standard_normal(answer.shape)
    ahead, behind = (
        plain(EXPRESSIONS[name](*(Followed(table + step * way) for table, way in zip(tables, ways, strict=True))))
        for step in (1e-6, -1e-6)
    )
    found = pulled_back([answer], [slope], followed)
    along = sum(float((part * way).sum()) for part, way in zip(found, ways, strict=True))
    assert along == pytest.approx(float(((ahead - behind) / 2e-6 * slope).sum()), rel=1e-6)


def test_outputs_that_depend_on_nothing() -> None:
    a, b = Followed(np.ones(2)), Followed(np.ones(3))
    found = pulled_back([a * 2.0, np.ones(3), b], [np.ones(2), np.ones(3), None], [a, b])
    np.testing.assert_array_equal(found[0], [2.0, 2.0])
    np.testing.assert_array_equal(found[1], np.zeros(3))


def test_comparisons_are_constants() -> None:
    a = Followed(np.array([1.0, 2.0, 3.0]))
    for mask in (a < 2.0, a <= 1.0, a < 2.0, a == 1.0, ~(a != 1.0), ~(a >= 2.0)):
        np.testing.assert_array_equal(mask, [True, False, False])
    assert (len(a), a.ndim, a.argmax()) == (3, 1, 2)
