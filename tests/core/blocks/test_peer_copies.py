"""Opening the memory of two GPUs to each other, with warp's functions noted instead of called: no GPU is needed."""

from __future__ import annotations

from typing import Any

import pytest
import warp as wp

from geokit.core.blocks.peer_copies import open_memory

ONE: Any = "cuda:0"
OTHER: Any = "cuda:1"


class Driver:
    """Which access is open, and what was done in which order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, pools: bool = True) -> None:
        self.open: set[tuple[str, str, str]] = set()
        self.done: list[tuple[str, ...]] = []
        monkeypatch.setattr(wp, "synchronize_device", lambda device: self.done.append(("idle", device)))
        for kind, supported in (("peer", True), ("mempool", pools)):
            monkeypatch.setattr(wp, f"is_{kind}_access_supported", lambda *_, supported=supported: supported)
            monkeypatch.setattr(wp, f"is_{kind}_access_enabled", lambda *two, kind=kind: (kind, *two) in self.open)
            monkeypatch.setattr(wp, f"set_{kind}_access_enabled", lambda *two, kind=kind: self.enable(kind, *two))

    def enable(self, kind: str, target: str, peer: str, on: bool) -> None:
        assert on
        self.open.add((kind, target, peer))
        self.done.append((kind, target, peer))


BOTH_WAYS = {(kind, *two) for kind in ("peer", "mempool") for two in ((ONE, OTHER), (OTHER, ONE))}


def test_access_opens_both_ways_and_only_while_both_gpus_are_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch)
    open_memory(ONE, OTHER)
    assert driver.open == BOTH_WAYS
    idle = [("idle", ONE), ("idle", OTHER)]
    assert driver.done[:2] == idle
    assert driver.done[4:6] == idle
    assert len(driver.done) == 8


def test_what_is_open_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch)
    driver.open = set(BOTH_WAYS)
    open_memory(ONE, OTHER)
    assert not driver.done
    driver.open.remove(("mempool", OTHER, ONE))
    open_memory(ONE, OTHER)
    assert driver.done == [("idle", ONE), ("idle", OTHER), ("mempool", OTHER, ONE)]


def test_what_is_not_supported_stays_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch, pools=False)
    open_memory(ONE, OTHER)
    assert {kind for kind, *_ in driver.open} == {"peer"}
