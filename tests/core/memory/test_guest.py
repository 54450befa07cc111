"""Warp's native code while a public operation runs: silent, and the thread's current GPU stays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from geokit.core import launcher
from geokit.core.memory import needs
from geokit.errors import InputError


class Library:
    """What warp's compiled library is asked for."""

    def __init__(self) -> None:
        self.prints, self.stack, self.deepest = 1, ["the caller's"], 0

    def wp_is_error_output_enabled(self) -> int:
        return self.prints

    def wp_set_error_output_enabled(self, prints: int) -> None:
        self.prints = prints

    def wp_cuda_context_push_current(self, context: Any) -> None:
        self.stack.append(context)
        self.deepest = max(self.deepest, len(self.stack))

    def wp_cuda_context_pop_current(self) -> None:
        self.stack.pop()


GPUS = [SimpleNamespace(context="first"), SimpleNamespace(context="second")]


@pytest.mark.parametrize("count", [1, 2])
def test_nothing_is_printed_and_of_several_gpus_the_current_one_stays(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library()
    monkeypatch.setattr(needs, "_native", None)
    needs.be_a_guest(library, GPUS[:count])

    @needs.needs()
    def inner(fails: bool) -> None:
        assert library.prints == 0
        # Warp makes another device current.
        library.stack[-1] = "second" if count > 1 else "the caller's"
        if fails:
            raise InputError("refused")

    @needs.needs()
    def outer(fails: bool) -> None:
        inner(fails)

    outer(False)
    with pytest.raises(InputError, match="refused"):
        outer(True)
    assert (library.prints, library.stack) == (1, ["the caller's"])
    assert library.deepest == (3 if count > 1 else 0)


def test_the_first_call_looks_where_torch_is(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    cuda = SimpleNamespace(is_initialized=lambda: True, device_count=lambda: 2)
    monkeypatch.setitem(__import__("sys").modules, "torch", SimpleNamespace(cuda=cuda))
    assert needs.loaders == [launcher.cuda_devices]
    monkeypatch.setattr(needs, "loaders", [lambda: asked.append(True)])
    monkeypatch.setattr(needs, "_native", None)
    needs.needs()(lambda: None)()
    assert asked == [True]
