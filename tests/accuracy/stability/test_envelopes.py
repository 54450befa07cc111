"""Every envelope that docs/stability.md states holds, and none is so wide that it says nothing.

The page itself follows every sweep through all of its values; here it is two of those that the envelope covers, and
beyond it as many as it takes to see the promise broken.
"""

from __future__ import annotations

import functools

import pytest

from geokit.accuracy import Outcome, Sweep, follow, sweeps
from geokit.accuracy.stability.follow_sweeps import inside, keeps, promised

SWEEPS = {sweep.name: sweep for sweep in sweeps("cpu")}
# What a statement says where no value was found at which the method fails.
UNBROKEN = "no failure"


@functools.cache
def asked(name: str, value: float) -> Outcome:
    return follow(SWEEPS[name], (value,))[0]


def some_inside(sweep: Sweep) -> list[float]:
    """The value in the middle of those that the envelope covers, and the last, which is the hardest."""
    covered = [value for value in sweep.values if inside(sweep, value)]
    return list(dict.fromkeys((covered[len(covered) // 2], covered[-1]))) if covered else []


def test_names_are_different():
    assert len(SWEEPS) == len(sweeps("cpu")) >= 10


@pytest.mark.slow
@pytest.mark.parametrize("name", SWEEPS)
def test_the_promise_holds_inside(name):
    sweep = SWEEPS[name]
    values = some_inside(sweep)
    assert values, "the envelope covers no value of its sweep"
    assert values[-1] == sweep.envelope.last, "the last value that is promised is not one that is asked"
    for value in values:
        outcome = asked(name, value)
        assert keeps(sweep, outcome), (outcome, promised(sweep, value))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:thin_plate")  # whose faces coincide at its thinnest, and enclose nothing
@pytest.mark.filterwarnings("ignore:.*(has no surface at|nothing of grid)")
@pytest.mark.parametrize("name", SWEEPS)
def test_the_envelope_says_something(name):
    sweep = SWEEPS[name]
    assert len(sweep.values) >= 3
    assert len(sweep.envelope.statement) > 20
    assert sweep.envelope.statement.endswith(".")
    assert 0.0 <= sweep.envelope.wrong_share < 1.0
    steps = [b - a for a, b in zip(sweep.values, sweep.values[1:], strict=False)]
    assert all(step > 0 for step in steps) or all(step < 0 for step in steps)
    if UNBROKEN in sweep.envelope.statement:
        return
    beyond = [value for value in sweep.values if not inside(sweep, value)]
    # From the end, where it is worst: most break there.
    assert any(not keeps(sweep, asked(name, value)) for value in reversed(beyond)), (
        f"nothing in {beyond} breaks the promise: widen the envelope, or say in its statement that {UNBROKEN} was found"
    )
