"""Ctrl-C, closed standard streams and limits of processes, in real processes."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from geokit._packages import require_package
from geokit.cli._batches import schedule, worker
from geokit.cli._program.console import step
from geokit.errors import WorkerError
from tests.cli.conftest import ROOT, SECONDS

pytestmark = pytest.mark.process

# Interrupts within a drawing, which takes a second or two.
PLACES = 8


def started(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "geokit", *map(str, arguments)], text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, **options,
    )  # fmt: skip


def refused_thread(_):
    raise RuntimeError("can't start new thread")


def interruptible():
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Says when the command line runs: an interrupt before it does is Python's own.
TELLING = """
import sys, geokit.cli, geokit.cli._program.run as verbs
run = verbs.run
verbs.run = lambda arguments: [print("runs", flush=True), run(arguments)][1]
sys.exit(geokit.cli.main())
"""


def test_drawing_ends_by_130_wherever_it_is_interrupted(cube, tmp_path):
    command = [sys.executable, "-c", TELLING, "render", cube, "-o", tmp_path / "a.png", "--force"]
    whole = 0.0
    for place in range(PLACES):
        process = subprocess.Popen(
            command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=interruptible,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "runs\n"
        begun = time.monotonic()
        if place:
            time.sleep(whole * (place - 1) / PLACES)
            process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=SECONDS)
        whole = whole or time.monotonic() - begun
        # One that came late, on a machine with more to do at first than now, has nothing to interrupt.
        assert process.returncode in ((0, 130) if place else (0,)), said
        assert "Traceback" not in said


@pytest.mark.parametrize("caught", ["Exception('a library turned it')", "SystemExit(0)", "None"])
def test_an_interrupt_that_a_library_catches_is_one(caught):
    code = (
        "import signal, geokit.cli, geokit.cli._program.run as verbs\n"
        "def run(_):\n"
        "    try: signal.raise_signal(signal.SIGINT)\n"
        f"    except BaseException: caught = {caught}\n"
        "    return 0 if caught is None else 1\n"
        "verbs.run = run\n"
        "raise SystemExit(geokit.cli.main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS, preexec_fn=interruptible,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "geokit: interrupted\n")


def test_an_interrupt_that_comes_within_del_ends_the_command():
    """Python drops it there, and the command would go on to its end."""
    code = (
        "import signal, time, geokit.cli, geokit.cli._program.run as verbs\n"
        "class Freed:\n"
        "    def __del__(self): signal.raise_signal(signal.SIGINT)\n"
        "def run(_):\n"
        "    Freed()\n"
        "    for _ in range(1000): time.sleep(0.01)\n"
        "    print('went on')\n"
        "verbs.run = run\n"
        "raise SystemExit(geokit.cli.main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS, preexec_fn=interruptible,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "geokit: interrupted\n")


def test_an_import_is_not_divided(tmp_path, monkeypatch):
    """What catches all errors, as trimesh does, would take the interrupt for a package that is missing."""
    (tmp_path / "greedy.py").write_text(
        "import signal\n"
        "try:\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    found = True\n"
        "except BaseException:\n"
        "    found = False\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(KeyboardInterrupt):
        require_package("greedy")
    assert sys.modules.pop("greedy").found


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1, 2)], ids=str)
def test_closed_streams(closed, cube, tmp_path):
    def close():
        for number in closed:
            os.close(number)

    target = tmp_path / "b.ply"
    for arguments, code in ((("convert", cube, target), 0), (("info", tmp_path / "missing.obj"), 1)):
        process = started(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=close)
        out, err = process.communicate(timeout=SECONDS)
        assert process.returncode == code, err
        assert "missing" not in out
        assert ("missing" in err) == (code == 1 and 2 not in closed)
    assert target.read_bytes().startswith(b"ply\n")
    assert b"bytes" not in target.read_bytes()


def test_a_process_that_cannot_be_started_is_no_fault_of_the_file(monkeypatch):
    def refuse(*_, **__):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(worker.subprocess, "Popen", refuse)
    batch = {"steps": [], "staging": "s", "memory": None, "seconds": None}
    with pytest.raises(WorkerError, match=r"process cannot be started .*ulimit -u"):
        worker._Process(1).run(batch, "a.obj")


def test_a_batch_whose_pool_gets_no_thread_ends_by_name(monkeypatch):
    monkeypatch.setattr("threading.Thread.start", refused_thread)
    with (
        pytest.raises(WorkerError, match=r"process or thread cannot be started \(can't start new thread\).*ulimit -u"),
        schedule.local_workers(1) as workers,
    ):
        workers.submit({}, ["a.obj"], set())


def test_a_task_that_gets_no_thread_at_its_start_answers_lost():
    code = (
        "import threading\n"
        'def refuse(_): raise RuntimeError("can\'t start new thread")\n'
        "threading.Thread.start = refuse\n"
        "from geokit.cli._batches.task import main\n"
        "main()\n"
    )
    job = {"steps": [], "staging": "s", "input": "a.obj"}
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(job) + "\n", capture_output=True, text=True, timeout=SECONDS,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    record = json.loads(done.stdout)
    assert (record["input"], record["status"]) == ("a.obj", "lost"), done.stderr
    assert "can't start new thread" in record["error"]["message"]


def test_a_step_needs_no_thread(monkeypatch):
    monkeypatch.setattr("threading.Thread.start", refused_thread)
    with step("counting"):
        pass
