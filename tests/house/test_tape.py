"""No public function gives a tape of warp zeros: an array that requires gradients is carried, or refused by name."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk
from tests.support.public_calls import Call, Scene, public_calls

# Their queries carry the gradients.
HOLDERS = ("points.NeighborGrid", "points.NeighborGrid.update", "mesh.Surface.update", "volume.with_values")
# These take arrays of the host only, or seconds each.
LEFT_OUT = ("render.", "accuracy.", "volume.plan", "distributed.", "native.", "threads.")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder, before = tmp_path_factory.mktemp("tape"), Path.cwd()
    os.chdir(folder)
    yield Scene(folder)
    os.chdir(before)


def floats(value: Any) -> np.ndarray | None:
    """An argument as an array of floats; None if it is none."""
    if not isinstance(value, (np.ndarray, list, tuple)):
        return None
    try:
        array = np.asarray(value)
    except ValueError:  # a list of lists of different lengths
        return None
    return array if array.dtype.kind == "f" and array.ndim and array.size else None


def carries(answer: Any) -> bool:
    if isinstance(answer, tuple):
        return any(map(carries, answer))
    return isinstance(answer, wp.array) and answer.requires_grad


def outcome(call: Call, name: str, value: np.ndarray) -> str:
    """What is wrong when a tape records the call; empty if nothing is."""
    given = wp.array(value, dtype=wp.float64, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        try:
            answer = call(**{name: given})
        except gk.InputError as error:
            return "" if not tape.launches else f"recorded, then {error}"
    if call.name.split("(")[0] in HOLDERS:
        return "" if not tape.launches else "recorded what has no gradient"
    return "" if carries(answer) and len(tape.launches) else f"{name}: a {type(answer).__name__} without gradients"


@pytest.mark.slow
def test_each_public_function(scene: Scene) -> None:
    tried, found = 0, {}
    for call in public_calls(scene):
        for name, value in call.arguments.items():
            array = None if call.name.startswith(LEFT_OUT) else floats(value)
            if array is not None:
                tried += 1
                if wrong := outcome(call, name, array):
                    found[call.name] = wrong
    assert tried > 100
    assert found == {}
