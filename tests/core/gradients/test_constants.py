"""Public functions take what holds a torch tensor as a constant: none ends in an error of torch."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import geokit as gk  # noqa: E402
from tests.support.public_calls import Call, Scene, public_calls  # noqa: E402

# These take seconds each, or objects without tensors.
LEFT_OUT = ("render.view", "accuracy.", "distributed.", "native.", "threads.")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder, before = tmp_path_factory.mktemp("constants"), Path.cwd()
    os.chdir(folder)
    yield Scene(folder)
    os.chdir(before)


class Holders:
    """The same objects, holding tensors that require gradients; made once each, since some take a while."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[Any, list[Any]]] = {}

    def of(self, value: Any) -> list[Any]:
        if id(value) not in self._made:
            self._made[id(value)] = value, list(self._of(value))
        return self._made[id(value)][1]

    def _of(self, value: Any) -> Iterator[Any]:
        if isinstance(value, gk.mesh.TriangleMesh):
            yield gk.torch.Surface(_tensor(value.vertices), value.faces, device="cpu")
        elif isinstance(value, gk.mesh.Surface):
            yield gk.torch.Surface(_tensor(value.mesh.vertices), value.mesh.faces, device="cpu")
            yield gk.mesh.Surface((_tensor(value.mesh.vertices), value.mesh.faces), device="cpu")
        elif isinstance(value, gk.volume.SparseVolume) and value.info.grid_type in ("float", "double"):
            values = gk.volume.active_voxels(value).values
            yield gk.volume.with_values(value, _tensor(values.astype(np.float64)))
        elif isinstance(value, dict):
            some = {name: self.of(one) for name, one in value.items()}
            if any(some.values()):
                yield {name: (some[name] or [one])[0] for name, one in value.items()}
        elif isinstance(value, tuple):
            each = [self.of(one) for one in value]
            if any(each):
                yield tuple((given or [one])[0] for given, one in zip(each, value, strict=True))


def _tensor(values: Any) -> Any:
    return torch.tensor(values, requires_grad=True)


def trials(call: Call, holders: Holders) -> Iterator[tuple[str, Callable[[], Any]]]:
    owner = getattr(call.function, "__self__", None)
    for holder in [] if owner is None or inspect.isclass(owner) else holders.of(owner):
        if hasattr(holder, call.function.__name__):
            method = getattr(holder, call.function.__name__)
            yield f"{call.name} of {type(holder).__module__}", partial(method, **call.arguments)
    for name, value in call.arguments.items():
        for holder in holders.of(value):
            yield f"{call.name}: {name}", partial(call, **{name: holder})


@pytest.mark.slow
def test_each_public_function(scene: Scene) -> None:
    tried, wrong, holders = 0, {}, Holders()
    for call in public_calls(scene):
        for what, ask in () if call.name.startswith(LEFT_OUT) else trials(call, holders):
            tried += 1
            try:
                ask()
            except gk.InputError as error:
                # Others do not take this kind of object, or no pose of it.
                if "requires" in str(error):
                    wrong[what] = str(error)
            except Exception as error:
                wrong[what] = f"{type(error).__name__}: {error}"
    assert tried > 150
    assert wrong == {}


def test_answers_are_those_of_constants() -> None:
    ball = gk.mesh.sphere(segments=8)
    other = gk.mesh.Surface(gk.mesh.sphere(0.9, segments=8), device="cpu")
    held = gk.mesh.Surface((_tensor(ball.vertices), ball.faces), device="cpu")
    plain = gk.mesh.Surface(ball, device="cpu")
    assert gk.mesh.hausdorff(held, other, samples=0).max == gk.mesh.hausdorff(plain, other, samples=0).max
    made, expected = (gk.volume.from_mesh(one, tolerance=0.05, name="ball", device="cpu") for one in (held, plain))
    assert np.array_equal(made.nanovdb, expected.nanovdb)
    # The object keeps its tensor.
    assert held.closest_point([[2.0, 0, 0]]).distance.requires_grad


def test_attributes_at_points_of_numpy() -> None:
    ball = gk.mesh.sphere(segments=8)
    height = {"height": ball.vertices[:, 2]}
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(ball.vertices, ball.faces, vertex_data=height), device="cpu")
    rows = np.random.default_rng(0).standard_normal((20, 3))
    expected = surface.sample_attributes(rows)["height"]
    surface.update(_tensor(ball.vertices))
    assert np.array_equal(surface.sample_attributes(rows)["height"], expected)
    with pytest.raises(gk.InputError, match="points"):
        surface.sample_attributes(_tensor(rows))
