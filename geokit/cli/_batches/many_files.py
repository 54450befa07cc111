"""Runs one conversion for each of many files: a failure is reported, and the others go on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from geokit.cli._program.console import note, print_json, say
from geokit.core.files import extension
from geokit.core.require import require_count
from geokit.errors import FileAccessError, GeokitError, InputError

# Files that wait for a free job; results are told in the order of the files.
WAITING = 4

Work = Callable[[Path, Path], dict[str, Any]]


def targets_in(folder: Path, sources: Sequence[Path], to: str | None) -> list[Path]:
    """The file in ``folder`` that each source becomes: its name with another extension.

    Raises:
        InputError: ``to`` is missing, or two sources would become one file.
        FileAccessError: The folder cannot be made.
    """
    if to is None:
        raise InputError("--out-dir: needs --to with the extension of the new files, as in --to ply")
    made: dict[Path, Path] = {}
    for source in sources:
        target = folder / f"{source.name[: len(source.name) - len(extension(source))]}.{to.lstrip('.')}"
        if target in made:
            raise InputError(f"{source}: becomes {target} as {made[target]} does; convert them into different folders")
        made[target] = source
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileAccessError(f"{folder}: cannot be made ({error.strerror}); choose another --out-dir") from error
    return list(made)


def run_batch(
    work: Work, pairs: Sequence[tuple[Path, Path]], jobs: int, describe: Callable[[dict[str, Any]], str], *, json: bool
) -> int:
    """Call ``work`` for each source and target, ``jobs`` at a time, and report each.

    Returns:
        The exit code: 1 if a file failed.
    Raises:
        InputError: ``jobs`` is not a whole number from 1 up.
    """
    require_count(jobs, "--jobs", 1)
    summaries, failed = [], 0
    for outcome in _outcomes(work, pairs, jobs):
        if isinstance(outcome, GeokitError):
            failed += 1
            note(" ".join(str(outcome).split()))
        elif json:
            summaries.append(outcome)
        else:
            say(describe(outcome))
    if json:
        print_json(summaries)
    if failed:
        note(f"{failed} of {len(pairs)} files were not converted")
    return 1 if failed else 0


def _outcomes(work: Work, pairs: Sequence[tuple[Path, Path]], jobs: int) -> Iterator[dict[str, Any] | GeokitError]:
    def attempt(pair: tuple[Path, Path]) -> dict[str, Any] | GeokitError:
        try:
            return work(*pair)
        except GeokitError as error:
            # Its traceback would keep what the conversion had read.
            return error.with_traceback(None)

    if jobs == 1:
        yield from map(attempt, pairs)
        return
    pool = ThreadPoolExecutor(jobs, "convert")
    try:
        running = []
        for pair in pairs:
            running.append(pool.submit(attempt, pair))
            if len(running) >= jobs + WAITING:
                yield running.pop(0).result()
        for job in running:
            yield job.result()
    finally:
        pool.shutdown(cancel_futures=True)
