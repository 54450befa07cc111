"""Runs a recipe on one file, in a process of its own that reads jobs from stdin.

A job works in a folder of its own. Its last act is to rename that folder to one that is named by the input: this is
the commit. Of two processes that do the same file, the first one's work stays and the other's is dropped.

The folders of jobs are in a private one of the process, whose lock the system frees when the process ends. So the
processes that start later, also those of a batch that goes on after a kill, remove what is surely dead, and nothing
that is alive: tasks of a Dask cluster outlive their batch.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import queue
import re
import shutil
import socket
import sys
import threading
import time
import uuid
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from geokit.accuracy.trials.measuring import reset_high_water, resident_status
from geokit.cli._batches.recipe import GLOBAL, Step, is_made, names_of, output_name
from geokit.cli._batches.worker import unstarted, versions
from geokit.cli._program.app import build_app, build_commands
from geokit.cli._program.console import at_end
from geokit.cli._program.run import show_warning, usage_message
from geokit.core.base.private_folder import private_folder
from geokit.core.files import in_one_line, require_file
from geokit.core.running.answers import take_stdout
from geokit.errors import GeokitError

# Folders of the staging area, and what a committed folder holds.
WORK, DONE, OUTPUTS, RECORD = "work", "done", "outputs", "record.json"
# No file is to blame for these: the machine is.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
# Another process was first; the folder of the job is not there any more.
TAKEN, GONE = (errno.ENOTEMPTY, errno.EEXIST), (errno.ENOENT, errno.ESTALE)
# Longest notices and summaries that a manifest keeps [characters].
LONGEST = 2000
# An idle process ends after this time [s].
PATIENCE = 60.0

# The private folder of this process, by the staging folder of the batch that it works for.
_place: dict[Path, Path] = {}
_held = contextlib.ExitStack()


def key_of(source: str) -> str:
    """Name of an input's folders and its place among shards: a hash of its path."""
    return hashlib.sha256(os.fsencode(source)).hexdigest()[:24]


def hash_of(path: Path) -> str:
    """SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _working_folder(staging: Path) -> Path:
    if staging not in _place or not _place[staging].is_dir():
        _held.close()
        _place.clear()
        _place[staging] = _held.enter_context(private_folder(staging / WORK))
    return _place[staging]


def run_task(steps: list[Step], source: str, staging: Path) -> dict[str, Any]:
    """Run the steps on one file, and commit its folder.

    Returns:
        The record of the file: "done", "failed" with its error, or "no room" or "lost" (somebody has removed its
        folder, or the machine gave no process or thread), which are not committed.
    """
    started, key = time.perf_counter(), key_of(source)
    done = staging / DONE / key
    folder: Path | None = None
    with contextlib.suppress(OSError):  # done by a worker that was lost with its answer
        return dict(json.loads((done / RECORD).read_text(encoding="utf-8")))
    reset_high_water()
    record: dict[str, Any] = {"input": source, "status": "done", "host": socket.gethostname(), "versions": versions()}
    try:
        folder = _working_folder(staging) / f"{key}-{uuid.uuid4().hex[:8]}"
        folder.mkdir()
        (folder / OUTPUTS).mkdir()
        _run_steps(steps, Path(source), folder, record)
        (folder / OUTPUTS).stat()  # a folder goes away as a whole, so what failed for its absence finds it absent
        record["seconds"] = round(time.perf_counter() - started, 4)
        record["peak_bytes"] = resident_status("VmHWM")
        if record["status"] == "no room":
            raise OSError(errno.ENOSPC, record["error"]["message"])
        if record["status"] == "lost":
            return record
        with open(folder / RECORD, "w", encoding="utf-8") as file:
            json.dump(record, file)
            file.flush()
            os.fsync(file.fileno())
        folder.rename(done)
        return record
    except OSError as error:
        if error.errno in TAKEN:
            with contextlib.suppress(FileNotFoundError):  # recorded meanwhile
                return dict(json.loads((done / RECORD).read_text(encoding="utf-8")))
        status, message = "no room", f"{staging.parent}: {error.strerror or error}; make room there, and go on"
        if error.errno in (*TAKEN, *GONE):
            status, message = "lost", f"{staging}: others remove what tasks write there; end that, and go on"
        message += " with the same command"
        return {**record, "status": status, "error": {"type": "FileAccessError", "message": message}}
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _run_steps(steps: list[Step], source: Path, folder: Path, record: dict[str, Any]) -> None:
    """Fill the record with what the steps did."""
    names = names_of(source)
    names["previous"] = names["input"]
    notices, record["steps"] = io.StringIO(), []
    for number, step in enumerate(steps, 1):
        started, printed, target = time.perf_counter(), io.StringIO(), None
        try:
            if number == 1:
                found = require_file(source).stat()
                record.update(size=found.st_size, mtime_ns=found.st_mtime_ns, hash=hash_of(source))
            if step.output is not None:
                name = output_name(step.output, names)
                made = folder / (OUTPUTS if step.keep else "scratch")
                # One by one: with parents, a folder that has gone away would come back.
                for part in name.split("/"):
                    made.mkdir(exist_ok=True)
                    made /= part
                target = str(made)
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(notices), at_end:
                code = _command(step)({**names, "target": target or ""})
            if code:
                raise GeokitError(f"ended with exit code {code}")
            if target is not None and not made.is_file() and not is_made(name, _files(made.parents[name.count("/")])):
                raise GeokitError(f"{source}: the step made no {name}; change its output in the recipe")
            names["previous"] = names[f"step{number}"] = target or names["previous"]
        except (Exception, SystemExit) as error:
            record.update(_failure(error, number, step, folder))
            break
        summary = _summary(_scrubbed(printed.getvalue(), folder))
        record["steps"].append({"verb": step.verb, "seconds": round(time.perf_counter() - started, 4), **summary})
    if notices.getvalue():
        record["notices"] = _scrubbed(notices.getvalue(), folder)[-LONGEST:]
    if record["status"] == "done":
        kept = folder / OUTPUTS
        record["outputs"] = [
            {"name": name, "bytes": (kept / name).stat().st_size, "hash": hash_of(kept / name)} for name in _files(kept)
        ]


def _files(folder: Path) -> list[str]:
    """Names of all files in a folder and below, relative to it."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@lru_cache
def _command(step: Step) -> Callable[[dict[str, str]], Any]:
    """The command of a step, as a function of the names of a file: parsing takes longer than small files do."""
    marks = _Marks()
    line = step.words(marks, marks["target"] if step.output else None)
    if any(word[2:].partition("=")[0] in GLOBAL for word in step.options):
        return lambda names: build_app()(
            [_filled(word, names) for word in line], exit_on_error=False, print_error=False
        )
    command, bound, _ = build_commands().parse_args(line, exit_on_error=False, print_error=False)

    def filled(value: Any, names: dict[str, str]) -> Any:
        if isinstance(value, (list, tuple)) and any(isinstance(item, Path) for item in value):
            return type(value)(filled(item, names) for item in value)
        return Path(_filled(str(value), names)) if isinstance(value, Path) else value

    def call(names: dict[str, str]) -> Any:
        options = {name: filled(value, names) for name, value in bound.kwargs.items()}
        return command(*(filled(value, names) for value in bound.args), **options)

    return call


class _Marks(dict[str, str]):
    """Marks in place of names, of a character that no name of a file has."""

    def __missing__(self, key: str) -> str:
        return f"\0{key}\0"


def _filled(text: str, names: dict[str, str]) -> str:
    return re.sub("\0(.*?)\0", lambda found: names[found[1]], text)


def _scrubbed(text: str, folder: Path) -> str:
    """Text with names as people know them, without the folder of the job."""
    return text.replace(f"{folder / OUTPUTS}{os.sep}", "").replace(f"{folder}{os.sep}", "")


def _summary(printed: str) -> dict[str, Any]:
    if 0 < len(printed) <= LONGEST:
        with contextlib.suppress(ValueError):
            return {"summary": json.loads(printed)}
    return {}


def _failure(error: BaseException, number: int, step: Step, folder: Path) -> dict[str, Any]:
    if type(error).__module__.startswith("cyclopts"):
        message = usage_message(error)
    else:
        expected = isinstance(error, (GeokitError, OSError))
        message = str(error) if expected else f"internal error: {type(error).__name__}: {error}"
    message = in_one_line(_scrubbed(message, folder), LONGEST)
    told = {"type": type(error).__name__, "message": message, "step": number, "verb": step.verb}
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in NO_ROOM:
            return {"status": "no room", "error": told}
        if why := unstarted(cause):
            return {"status": "lost", "error": {"type": "WorkerError", "message": why}}
        cause = cause.__cause__ or cause.__context__
    return {"status": "failed", "error": told}


def main() -> None:
    """Run the jobs that stdin holds, one JSON object a line, and write their records to stdout."""
    answers = take_stdout()
    warnings.showwarning = show_warning
    jobs: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            jobs.put(line)
        # Who asked is gone, even killed: nobody waits for what runs now, and it may be running elsewhere already.
        os._exit(1)

    try:
        threading.Thread(target=listen, daemon=True).start()
    except RuntimeError as error:  # without an answer, the first file would be blamed
        told = {"type": "WorkerError", "message": unstarted(error) or str(error)}
        answers.write(json.dumps({**json.loads(sys.stdin.readline()), "status": "lost", "error": told}) + "\n")
        os._exit(1)
    with contextlib.suppress(queue.Empty):
        while True:
            job = json.loads(jobs.get(timeout=PATIENCE))
            steps = [
                Step(**{**step, "options": tuple(step["options"]), "files": tuple(step["files"])})
                for step in job["steps"]
            ]
            answers.write(json.dumps(run_task(steps, job["input"], Path(job["staging"]))) + "\n")
    os._exit(0)
