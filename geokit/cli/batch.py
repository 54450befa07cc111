"""``geokit batch``: runs a recipe of commands on many files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geokit.cli._batches.manifest import Manifest, merge, own_files, read_manifest, write_failures
from geokit.cli._batches.recipe import Recipe, output_names, read_recipe
from geokit.cli._batches.report import totals, write_report
from geokit.cli._batches.schedule import local_workers, remote_workers, run_all
from geokit.cli._batches.task import key_of
from geokit.cli._batches.worker import versions
from geokit.cli._kinds import Flag, may_write
from geokit.cli._program.console import note, print_json, say, step
from geokit.core.files import require_file
from geokit.core.require import require_count, require_number
from geokit.errors import InputError


def batch(
    *files: Annotated[Path, Parameter(name="FILES")],
    out: Path,
    files_from: Path | None = None,
    scheduler: str | None = None,
    jobs: int | None = None,
    shard: str | None = None,
    task_memory: int | None = None,
    task_seconds: float | None = None,
    retry_failed: Flag = False,
    merge: Flag = False,
    force: Flag = False,
    json: Flag = False,
) -> int:
    """Run a recipe on many files: RECIPE.toml INPUT ... The same command again goes on where it was stopped.

    Args:
        files: The recipe, then the files. With --merge, the manifests of shards.
        out: Folder for what the recipe makes, the manifest, the list of failures and the report. With --merge, the
            manifest to write.
        files_from: A text file that names further files, one a line; only newlines, or CR LF, end a line.
        scheduler: Address of a Dask scheduler, as in tcp://host:8786, or local for a cluster of this machine; by
            default, processes of this machine without Dask.
        jobs: Number of processes of this machine; by default one for each core.
        shard: Do one part of the files, as in 3/64; the manifests of the parts can be merged.
        task_memory: Largest resident memory in bytes of the process that does a file; the file fails beyond it.
        task_seconds: Longest time in seconds that a file may take, with the start of its process (a second or two); the
            file fails beyond it. By default a file may take any time.
        retry_failed: Do files again that failed before.
        merge: Write one manifest of several.
        force: Replace files in the folder that are not of this batch.
        json: Print a summary as JSON.
    """
    if merge:
        may_write(out, force=force)
        return _merged(files, out, json=json)
    if not files:
        raise InputError("RECIPE.toml: is missing; name a recipe and the files")
    part = _shard(shard)
    jobs = os.cpu_count() or 1 if jobs is None else require_count(jobs, "--jobs", 1)
    if task_memory is not None:
        require_count(task_memory, "--task-memory", 1)
    if task_seconds is not None and not require_number(task_seconds, "--task-seconds") > 0:
        raise InputError(f"--task-seconds: {task_seconds:g} is no time; give one above 0")
    recipe = read_recipe(files[0])
    sources = list(_sources(files[1:], files_from))
    _refuse_collisions(recipe, sources)
    if part is not None:
        sources = [source for source in sources if int(key_of(source), 16) % part[1] == part[0] - 1]
    with Manifest(out, recipe, part) as manifest:
        todo = [source for source in sources if not manifest.is_done(source, retry_failed)]
        manifest.check_outputs(todo, force)
        threads = 1 if scheduler else max(1, (os.cpu_count() or 1) // jobs)
        work: dict[str, Any] = {
            "steps": [asdict(step) for step in recipe.steps],
            "staging": str(manifest.staging.absolute()),
            "versions": versions(),
            "memory": task_memory,
            "seconds": task_seconds,
            "threads": threads,
        }
        before, failed = len(sources) - len(todo), 0
        if before:
            note(f"{before} of {len(sources)} files are done already")
        with step(f"{len(todo)} files", quiet=json) as running:
            if todo:
                pool = remote_workers(scheduler, jobs, work["staging"]) if scheduler else local_workers(jobs)
                done = 0

                def add(records: list[dict[str, Any]]) -> None:
                    nonlocal done, failed
                    manifest.add(records)
                    done += len(records)
                    failed += sum("error" in record for record in records)
                    running.title = f"{done} of {len(todo)} files, {failed} failed"
                    running.progress(done, len(todo))

                with pool as workers:
                    run_all(work, todo, workers, add, note)
        here = {source: manifest.records[source] for source in sources}
        suffix = manifest.path.stem.removeprefix("manifest")
        return _finished(here, recipe.text, out, suffix, json=json)


def _finished(records: dict[str, dict[str, Any]], recipe: str, folder: Path, suffix: str, *, json: bool) -> int:
    failures, page = own_files(folder, suffix)
    failed = write_failures(records, failures)
    write_report(records, recipe, page)
    if json:
        print_json({**totals(records), "failures": str(failures), "report": str(page)})
    else:
        say(f"{page}: {len(records) - failed} files done, {failed} failed" + (f" ({failures})" if failed else ""))
    return 1 if failed else 0


def _merged(paths: Sequence[Path], target: Path, *, json: bool) -> int:
    header, _ = read_manifest(paths[0]) if paths else ({}, {})
    records = merge(paths, target)
    return _finished(records, header["recipe"], target.parent, f"-{target.stem}", json=json)


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InputError(f"--shard: {text!r} is not a part; write it as in 3/64, from 1/64 to 64/64")
    return int(number), int(count)


def _sources(files: Sequence[Path], listed: Path | None) -> Iterator[str]:
    """The files to do, each once, as absolute paths."""
    lines: list[str] = []
    if listed is not None:
        # Names may hold other characters that splitlines() and text mode take for line ends.
        text = require_file(listed).read_bytes().decode("utf-8", "surrogateescape")
        lines = [line.removesuffix("\r") for line in text.split("\n")]
    seen = dict.fromkeys(os.path.abspath(file) for file in [*map(str, files), *filter(str.strip, lines)])
    if not seen:
        raise InputError("no files are given; name them after the recipe, or in a list with --files-from")
    yield from seen


def _refuse_collisions(recipe: Recipe, sources: Sequence[str]) -> None:
    made: dict[str, str] = {}
    for source in sources:
        for name in output_names(recipe, Path(source)) or ():
            if made.setdefault(name, source) != source:
                raise InputError(
                    f"{source}: would become {name}, as {made[name]} does; write {{folder}} into output, as in "
                    "{folder}/{stem}.nvdb, or use one --out for each folder"
                )
