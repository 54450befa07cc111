"""What the system says of this process, and what is known where it says nothing."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import pytest

from geokit.core.base.system import UNLIMITED, limits, said
from geokit.core.memory.available_memory import ASSUMED_BYTES, available_host


def test_limits_are_those_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", {resource.RLIMIT_AS: (5, resource.RLIM_INFINITY)}.get)
    assert limits("AS") == [5, UNLIMITED]
    monkeypatch.setitem(sys.modules, "resource", None)
    assert limits("AS") == [UNLIMITED, UNLIMITED]


def test_words_of_the_first_line_that_begins_with_a_name(tmp_path: Path) -> None:
    (tmp_path / "status").write_text("VmSize:\t 17 kB\nVmHWM:\t 4 kB\nVmHWM:\t 5 kB\n", encoding="utf-8")
    assert said(tmp_path / "status", "VmHWM:") == ["4", "kB"]
    assert said(tmp_path / "status", "VmRSS:") == said(tmp_path / "none", "VmHWM:") == []


def test_memory_is_assumed_where_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    known = available_host()
    monkeypatch.setattr("geokit.core.memory.available_memory.said", lambda *_: [])
    monkeypatch.delattr("os.sysconf")
    assert available_host() <= ASSUMED_BYTES
    assert known > 0
