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
    record = process.run({"steps": [], "staging": "", "memory": None, "seconds": None}, "a.obj")
    assert [one.returncode for one in started] == [-9]
    assert record["status"] == "failed"


@pytest.mark.parametrize("has_groups", [True, False])
def test_a_file_that_takes_too_long_fails_and_its_process_is_ended(
    has_groups: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_groups:
        monkeypatch.delattr("os.killpg")
    started: list[subprocess.Popen[bytes]] = []
    process, start = worker._Process(1), subprocess.Popen

    def start_slow(command: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(start(["sleep", "60"], **options))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start_slow)
    record = process.run({"steps": [], "staging": "", "memory": None, "seconds": 0.05}, "a.obj")
    assert [one.returncode for one in started] == [-9]  # it is not tried again
    assert record["status"] == "failed"
    message = "a.obj: takes more than the 0.05 s of --task-seconds; raise it, or mend the file"
    assert record["error"] == {"type": "WorkerError", "message": message}
