"""The processes that do the files of a batch."""

from __future__ import annotations

import subprocess

import pytest

from geokit.cli._batches import worker

pytestmark = pytest.mark.process


def test_a_process_that_starts_while_all_are_ended_is_ended_too(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    process, start = worker._Process(1), subprocess.Popen

    def start_late(command: object, **options: object) -> subprocess.Popen[bytes]:
        worker.end_processes()  # Ctrl-C in the main thread, while this one starts the process
        started.append(start(["sleep", "60"], **options))  # type: ignore[call-overload]
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", start_late)
    record = process.run({"steps": [], "staging": "", "memory": None}, "a.obj")
    assert [one.returncode for one in started] == [-9]
    assert record["status"] == "failed"
