"""Runs many mutants of a target in worker processes, each for as many as it survives, with limits."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.originals import Target

__all__ = ["SLOWEST_SECONDS", "Tally", "Worker", "is_fault", "run"]

ROOT = Path(__file__).resolve().parents[2]
# Of CPU time, because the machine may be busy; a mutant that only waits is ended after PATIENCE times as long.
SLOWEST_SECONDS = 20.0
PATIENCE = 10
# Imports, and kernels that are compiled for the first time.
START_SECONDS = 600.0
# Opening files on a disk takes longer than reading most of the mutants.
MEMORY_FOLDER = Path("/dev/shm")


@dataclass
class Tally:
    """Ends of a target's mutants.

    Attributes:
        ends: How many ended how.
        differing: Of accepted mutants that differ from their originals: how many in what, by whether a checksum was
            made right again.
        faults: A line of JSON for each mutant that ended neither in an answer nor in a named error.
        slowest: Seconds of the slowest, its CPU time without that of processes that it waited for, and its seed.
        grown: Growth of the largest worker in MiB.
    """

    ends: Counter[str] = field(default_factory=Counter)
    differing: Counter[tuple[bool, str]] = field(default_factory=Counter)
    faults: list[dict[str, Any]] = field(default_factory=list)
    slowest: tuple[float, float, int] = (0.0, 0.0, 0)
    grown: int = 0

    def add(self, told: dict[str, Any]) -> None:
        end = told["end"]
        if is_fault(end):
            self.faults.append(told)
            self.ends[f"fault: {end.split(':')[0]}"] += 1
        elif end.startswith("differs"):
            self.ends["differs"] += 1
            self.differing[told.get("mended", False), end.removeprefix("differs in ")] += 1
        else:
            self.ends[end] += 1
        self.slowest = max(self.slowest, (told.get("seconds", 0.0), told.get("cpu", 0.0), told["seed"]))
        self.grown = max(self.grown, told.get("grown", 0))


def is_fault(end: str) -> bool:
    return end != "same" and not end.startswith(("refused by ", "differs in "))


class Worker:
    """A process that makes and loads mutants, of one target after the other."""

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory(dir=MEMORY_FOLDER if MEMORY_FOLDER.is_dir() else None)
        self.process = subprocess.Popen(
            [sys.executable, "-W", "always", "-m", "tests.fuzz.worker", self.folder.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            cwd=ROOT,
            env={**os.environ, "GEOKIT_THREADS": "1"},
            start_new_session=True,
        )

    def prepare(self, target: Target) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(f"{target.content} {target.kind}\n".encode())
        if not _line(self.process, START_SECONDS):
            raise RuntimeError(f"the worker of {target} did not start")

    def close(self) -> None:
        # Readers of other libraries that it waits for end with it.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with self.process:  # closes its pipes
            pass
        self.folder.cleanup()


def run(
    target: Target, seeds: range, *, workers: int = 1, keep: Path | None = None, idle: list[Worker] | None = None
) -> Tally:
    """Run the mutants of some seeds.

    Args:
        target: Of which format.
        seeds: One for each mutant.
        workers: Number of processes.
        keep: Folder that gets the files of mutants that are faults; None for none.
        idle: Processes that are taken from here, and left here for the next target; None to end them.
    """
    tally, own = Tally(), list[Worker]()

    def share(seeds: range) -> list[dict[str, Any]]:
        return list(_ends(target, seeds, keep, own if idle is None else idle))

    try:
        with ThreadPoolExecutor(workers) as pool:
            for ends in pool.map(share, [seeds[i::workers] for i in range(workers)]):
                for told in ends:
                    tally.add(told)
    finally:
        for worker in own:
            worker.close()
    return tally


def _ends(target: Target, seeds: range, keep: Path | None, idle: list[Worker]) -> Iterator[dict[str, Any]]:
    waiting = list(seeds)[::-1]
    while waiting:
        worker, dead = idle.pop() if idle else Worker(), True
        try:
            worker.prepare(target)
            dead = False
            while waiting and not dead:
                seed = waiting.pop()
                told = _told(worker.process, seed)
                dead = "variant" not in told
                if is_fault(told["end"]) and keep is not None:
                    _keep(target, Path(worker.folder.name), told, keep)
                yield told
        finally:
            worker.close() if dead else idle.append(worker)


def _told(process: subprocess.Popen[bytes], seed: int) -> dict[str, Any]:
    """What a worker says of a mutant, or how it ended if it says nothing."""
    assert process.stdin is not None
    before = _cpu_seconds(process.pid)
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(b"%d\n" % seed)
    for _ in range(PATIENCE):
        line = _line(process, SLOWEST_SECONDS)
        if line:
            return dict(json.loads(line))
        if line is not None:
            status = process.wait()
            return {"seed": seed, "end": f"crash: {signal.Signals(-status).name if status < 0 else status}"}
        if _cpu_seconds(process.pid) - before > SLOWEST_SECONDS:
            break
    return {"seed": seed, "end": "hang"}


def _line(process: subprocess.Popen[bytes], seconds: float) -> bytes | None:
    """A line of a worker; empty if it has ended, None if it says nothing in time."""
    assert process.stdout is not None
    # One line is written at a time, and none is left in the buffer.
    if not select.select([process.stdout], [], [], seconds)[0]:
        return None
    return process.stdout.readline()


def _cpu_seconds(session: int) -> float:
    """CPU time of a worker and the processes that it has started."""
    ticks = 0
    for process in filter(str.isdecimal, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            # The name of the program comes second, and may hold anything.
            fields = Path("/proc", process, "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session:
                ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def _keep(target: Target, folder: Path, told: dict[str, Any], keep: Path) -> None:
    place = keep / f"{target.content}{target.kind}-{told['seed']}"
    place.mkdir(parents=True, exist_ok=True)
    (place / "end.json").write_text(json.dumps(told))
    for path in folder.glob("a*"):
        if path.is_dir():
            shutil.copytree(path, place / path.name, dirs_exist_ok=True)
        else:
            shutil.copy(path, place / path.name)
