"""Throughput of ``geokit batch``, what a scheduler bears, and an estimate for a thousand workers.

``python -m benchmarks.file_batches_cluster [--count N] [--jobs N]``. Files are tetrahedra that become .off files: the
work is a few milliseconds, so that what is measured is what a batch adds. The load of the scheduler is its processor
time, which other work of the machine does not change. The estimate for many workers is a simulation by the very rule
that sizes tasks, with the measured times of the scheduler and of the process that writes the manifest.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import io
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from geokit.cli import main as geokit
from geokit.cli._batches.manifest import Manifest
from geokit.cli._batches.recipe import read_recipe
from geokit.cli._batches.schedule import AHEAD, TASKS_PER_SECOND, files_per_task
from geokit.cli._batches.task import key_of, run_task
from geokit.cli._batches.worker import versions

RECIPE = '[[step]]\nverb = "convert"\noutput = "{stem}.off"\n'
BODY = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def convert(pair: tuple[str, str]) -> None:
    gk.mesh.save(pair[1], gk.mesh.load(pair[0]))


def throughput(folder: Path, count: int, jobs: int) -> None:
    sources = [folder / f"a{number:06}.obj" for number in range(count)]
    for source in sources:
        source.write_text(BODY)
    recipe, listed = folder / "recipe.toml", folder / "list.txt"
    recipe.write_text(RECIPE)
    listed.write_text("".join(f"{source}\n" for source in sources))

    def pairs(name: str) -> list[tuple[str, str]]:
        (folder / name).mkdir()
        return [(str(source), str(folder / name / f"{source.stem}.off")) for source in sources]

    def loop() -> None:
        for pair in pairs("loop"):
            convert(pair)

    def pool() -> None:
        with multiprocessing.get_context("spawn").Pool(jobs) as workers:
            workers.map(convert, pairs("pool"), chunksize=16)

    def batch(*more: str) -> None:
        out = folder / "-".join(("out", *(word.strip("-") for word in more)))
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert geokit(["batch", str(recipe), "--files-from", str(listed), "--out", str(out), *more]) == 0

    print(f"| {count} files | files a second | processor time a file [ms] |\n|---|---|---|")
    for name, run in (
        ("one process, a loop", loop),
        (f"multiprocessing.Pool({jobs})", pool),
        ("geokit batch --jobs 1", lambda: batch("--jobs", "1")),
        (f"geokit batch --jobs {jobs}", lambda: batch("--jobs", str(jobs))),
        (f"geokit batch --jobs {jobs} --scheduler local", lambda: batch("--jobs", str(jobs), "--scheduler", "local")),
    ):
        start, before = time.perf_counter(), sum(os.times()[:4])
        run()
        spent = sum(os.times()[:4]) - before
        print(f"| {name} | {count / (time.perf_counter() - start):.0f} | {1e3 * spent / count:.1f} |", flush=True)


def tiny(batch: dict[str, Any], sources: list[str]) -> list[dict[str, Any]]:
    """What a task sends there and back, without its work."""
    return [{"input": source, "status": "done", "versions": versions(), "hash": "0" * 64} for source in sources]


def scheduler_seconds(folder: Path, count: int) -> float:
    """Processor time of the scheduler for a task [s]."""
    import distributed

    facts = folder / "scheduler.json"
    known = ["--scheduler-file", str(facts), "--no-dashboard"]
    programs = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{name}", *known, *more], stderr=subprocess.DEVNULL
        )
        for name, more in (("scheduler", ["--port", "0"]), ("worker", ["--nthreads", "32", "--no-nanny"]))
    ]
    try:
        while not facts.is_file():
            time.sleep(0.1)
        with distributed.Client(scheduler_file=str(facts)) as client:
            client.wait_for_workers(1)
            work = {"steps": [{"verb": "convert", "options": ["--json"], "files": ["{previous}"]}], "staging": "/out"}
            client.gather([client.submit(tiny, work, [str(number)], pure=False) for number in range(200)])
            before = client.run_on_scheduler(time.process_time)
            flying = distributed.as_completed([])
            for number in range(count):
                flying.add(client.submit(tiny, work, [str(number)], pure=False))
                if flying.count() > 64:
                    next(flying)
            for _ in flying:
                pass
            return float(client.run_on_scheduler(time.process_time) - before) / count
    finally:
        for program in programs:
            program.kill()
            program.wait()


def manifest_seconds(folder: Path, count: int) -> float:
    """Time of the process that moves outputs and writes records, for a file [s]."""
    recipe = read_recipe(folder / "recipe.toml")
    with Manifest(folder / "manifest", recipe, None) as manifest:
        records = []
        for number in range(count):
            source = folder / f"b{number}.obj"
            source.write_text(BODY)
            records.append(run_task(list(recipe.steps), str(source), manifest.staging))
            assert (manifest.staging / "done" / key_of(str(source))).is_dir()
        start = time.perf_counter()
        for first in range(0, count, 64):
            manifest.add(records[first : first + 64])
        return (time.perf_counter() - start) / count


def simulated(files: int, workers: int, seconds: float, task: float, record: float, *, grouped: bool) -> float:
    """Share of the workers' time that is work: files of log-normal times (sigma 1), tasks sized as by geokit batch.

    The scheduler starts one task after the other, ``task`` seconds each, and one process takes ``record`` seconds for
    each file; a task is sent when less than ``AHEAD`` tasks for each worker are not recorded.
    """
    times = np.random.default_rng(1).lognormal(np.log(seconds) - 0.5, 1.0, files)
    idle, flying = [0.0] * workers, []  # type: ignore[var-annotated]
    left, scheduler, recorded = files, 0.0, 0.0

    def write() -> None:
        nonlocal recorded
        end, size = heapq.heappop(flying)
        recorded = max(recorded, end) + record * size

    while left:
        if len(flying) == AHEAD * workers:
            write()
        size = files_per_task(left, workers, seconds if grouped else None, TASKS_PER_SECOND)
        scheduler = max(scheduler, recorded) + task
        end = max(heapq.heappop(idle), scheduler) + float(times[left - size : left].sum())
        heapq.heappush(idle, end)
        heapq.heappush(flying, (end, size))
        left -= size
    while flying:
        write()
    return float(times.sum() / workers / recorded)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where the files are; by default the system's temporary folder")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(dir=given.folder))
    try:
        throughput(folder, given.count, given.jobs)
        task, record = scheduler_seconds(folder, given.count), manifest_seconds(folder, min(given.count, 500))
        print(json.dumps({"scheduler_us_a_task": round(1e6 * task), "manifest_us_a_file": round(1e6 * record)}))
        print(
            "| seconds a file | files a task | 1,000 workers | one file a task | no overhead |\n|---|---|---|---|---|"
        )
        for seconds in (0.1, 1.0, 10.0, 60.0):
            size = files_per_task(10**5, 1000, seconds, TASKS_PER_SECOND)
            shares = [simulated(10**5, 1000, seconds, task, record, grouped=grouped) for grouped in (True, False)]
            shares.append(simulated(10**5, 1000, seconds, 0.0, 0.0, grouped=False))
            print(f"| {seconds:g} | {size} | " + " | ".join(f"{100 * share:.0f} %" for share in shares) + " |")
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
