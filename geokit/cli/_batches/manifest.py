"""The manifest of a batch, JSON lines: a header and a record of each file; and the folders of committed work.

Work is committed by its process (task.py), then its outputs are moved to their place, then its record is written, then
its folder goes. Each of these steps can be repeated, so a batch that is killed between two of them goes on from there.

What is found there may come from somebody else, as in an archive that was unpacked or a shared folder: nothing outside
the folder of the batch is written or removed for it, and committed work that the recipe does not make is done again.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import operator
import os
import shutil
import stat
import uuid
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from geokit.cli._batches.recipe import Recipe, is_made, output_names, refusal_of
from geokit.cli._batches.task import DONE, OUTPUTS, RECORD, WORK, key_of
from geokit.cli._batches.worker import versions
from geokit.core.base.printable import printable
from geokit.core.base.private_folder import make_own, remove_folder
from geokit.core.files import atomic_path
from geokit.core.running.thread_placement import Pool
from geokit.errors import FileAccessError, FileFormatError, InputError

FORMAT = 1
STAGING = ".geokit-batch"
# What is of no use any more, in the staging area: only who writes the manifest puts folders there and removes them.
GONE = "gone"
# What is not needed again: of 100,000 files it would fill the memory.
LEFT_OUT = ("steps", "notices")
# Files whose outputs are moved at a time.
MOVERS = 8


class Manifest:
    """The manifest of a batch in a folder, opened for writing by one process at a time.

    Args:
        folder: Where the batch writes.
        recipe: Its steps.
        shard: Which part, as (3, 64); None for all.
    Attributes:
        records: The last record of each input, without its steps and notices.
        staging: Folder in which work is done.
    Raises:
        InputError: The folder holds the batch of another recipe, or another process writes it; one of the batch's own
            files or folders there is a link, or somebody else could have filled it.
        FileAccessError: The folder cannot be made or written.
    """

    def __init__(self, folder: Path, recipe: Recipe, shard: tuple[int, int] | None) -> None:
        suffix = "" if shard is None else f"-{shard[0]}-of-{shard[1]}"
        self.folder, self.path, self.recipe = folder, folder / f"manifest{suffix}.jsonl", recipe
        self.staging = folder / f"{STAGING}{suffix}"
        header = {"geokit_batch": FORMAT, "recipe": recipe.text, "recipe_hash": recipe.hash, "shard": shard}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for path in (self.path, *own_files(folder, suffix)):
                if path.is_symlink():
                    raise InputError(f"{path}: is a link, which a batch does not follow; remove it")
            self.file = open(self.path, "a+b", buffering=0)  # noqa: SIM115, closed by close
        except OSError as error:
            raise FileAccessError(f"{folder}: cannot write there ({error.strerror}); choose another --out") from error
        try:
            import fcntl

            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.file.close()
            raise InputError(
                f"{self.path}: another batch is writing it; wait for it, or choose another --out"
            ) from error
        except (OSError, ImportError):  # the file system or the system has no locks
            pass
        self._pool = Pool(MOVERS, "batch-moves")
        try:
            found, self.records, end = _parsed(self.path, LEFT_OUT)
            if found is not None and found["recipe_hash"] != recipe.hash:
                raise InputError(f"{self.path}: is of another recipe (or its files changed); choose another --out")
            with self._writing():
                self.file.truncate(end)  # a line that a killed process did not end
                if found is None:
                    self._write([{**header, "versions": versions()}])
                for place in (self.staging, *(self.staging / name for name in (WORK, DONE, GONE))):
                    make_own(place)
                for left in (self.staging / GONE).iterdir():
                    remove_folder(left)
                self._go_on()
        except BaseException:
            self.__exit__(True)
            raise

    def __enter__(self) -> Manifest:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            # As a whole first: tasks of a killed batch that still run fail at once, know why, and cannot commit.
            with contextlib.suppress(OSError):
                (self.staging / WORK).rename(self.staging / GONE / WORK)
            remove_folder(self.staging)
        self.file.close()

    def is_done(self, source: str, retry: bool) -> bool:
        """Whether an input needs no work: it and its outputs are as they were; failures count unless retried."""
        record = self.records.get(source)
        if record is None or (retry and record["status"] != "done"):
            return False
        try:
            found = os.stat(source)
        except OSError:
            return record["status"] != "done"
        before = record.get("size", found.st_size), record.get("mtime_ns", found.st_mtime_ns)
        if before != (found.st_size, found.st_mtime_ns):
            return False
        return record["status"] != "done" or self._has_outputs(record)

    def _has_outputs(self, record: dict[str, Any], *folders: Path) -> bool:
        """Whether all that the recipe makes of an input is there."""
        names = [output["name"] for output in record.get("outputs", ())]
        if not all(any((folder / name).is_file() for folder in (self.folder, *folders)) for name in names):
            return False
        wanted = output_names(self.recipe, Path(record["input"]))
        return wanted is not None and all(is_made(name, names) for name in wanted)

    def check_outputs(self, todo: Iterable[str], force: bool) -> None:
        """Refuse to replace files that this batch has not made, unless forced, and links that lead out of its folder.

        Raises:
            InputError: There is one.
        """
        for source in todo:
            record = self.records.get(source, {})
            own = {output["name"] for output in record.get("outputs", ())}
            for name in output_names(self.recipe, Path(source)) or ():
                self._target(name)
                if not force and name not in own and (self.folder / name).exists():
                    raise InputError(f"{self.folder / name}: exists already; choose another --out, or add --force")

    def add(self, records: Iterable[dict[str, Any]]) -> None:
        """Move the outputs of committed work to their place, and write its records.

        Raises:
            FileAccessError: The disk is full, or not writable any more.
        """
        with self._writing():
            written, ended = [], list(records)
            folders = [self.staging / DONE / key_of(record["input"]) for record in ended]
            # Several at a time: on file systems of many machines each operation waits for an answer.
            committed = self._pool.map(lambda pair: self._place(*pair), zip(ended, folders, strict=True))
            for record, there in zip(ended, committed, strict=True):
                # A worker that was thought lost may finish what another one has done: its copy is dropped.
                if record["status"] == "done" and not there:
                    continue
                if _facts(record) != _facts(self.records.get(record["input"], {})):
                    self.records[record["input"]] = _without(record, LEFT_OUT)
                    written.append(record)
            self._write(written)
            self._pool.map(self._drop, folders)

    def _place(self, record: dict[str, Any], folder: Path) -> bool:
        """Move outputs to their place; False if there is no work to be found."""
        if not folder.is_dir():
            return False
        for output in record.get("outputs", ()):
            target = self._target(output["name"])
            target.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # moved before the batch was killed
                os.replace(folder / OUTPUTS / output["name"], target)
        return True

    def _target(self, name: str) -> Path:
        """Where an output goes; folders on the way may be links inside the folder of the batch, not out of it."""
        target = self.folder / name
        if target.parent != self.folder:
            real, root = os.path.realpath(target.parent), os.path.realpath(self.folder)
            if os.path.commonpath((real, root)) != root:
                raise InputError(f"{target.parent}: leads to {real}, out of {root}; remove that link")
        return target

    def _go_on(self) -> None:
        """Record the work that was committed when a batch was killed; what is not of this recipe is done again."""
        left = sorted((self.staging / DONE).iterdir())
        found = [_committed(folder) for folder in left]
        good = [self._is_ours(record, folder) for record, folder in zip(found, left, strict=True)]
        self._pool.map(self._drop, itertools.compress(left, map(operator.not_, good)))
        self.add(itertools.compress(found, good))

    def _is_ours(self, record: dict[str, Any], folder: Path) -> bool:
        if not record or key_of(record["input"]) != folder.name or record["status"] not in ("done", "failed"):
            return False
        if any(refusal_of(output["name"]) for output in record.get("outputs", ())):
            return False
        return record["status"] == "failed" or self._has_outputs(record, folder / OUTPUTS)

    def _drop(self, folder: Path) -> None:
        """Remove committed work: it leaves in one step, so that none without its record is ever found."""
        away = self.staging / GONE / f"{folder.name}-{uuid.uuid4().hex[:8]}"
        with contextlib.suppress(FileNotFoundError):
            folder.rename(away)
        shutil.rmtree(away, ignore_errors=True)

    def _write(self, records: Sequence[dict[str, Any]]) -> None:
        if records:
            data = b"".join(json.dumps(record).encode() + b"\n" for record in records)
            while data:
                data = data[self.file.write(data) or 0 :]
            os.fsync(self.file.fileno())

    @contextlib.contextmanager
    def _writing(self) -> Any:
        try:
            yield
        except OSError as error:
            if isinstance(error, (FileAccessError, InputError)):
                raise
            reason = error.strerror or error
            raise FileAccessError(f"{self.folder}: writing failed ({reason}); mend that, and run it again") from error


def own_files(folder: Path, suffix: str) -> tuple[Path, Path]:
    """The list of failures and the report of a batch, or of a part of it."""
    return folder / f"failures{suffix}.tsv", folder / f"report{suffix}.html"


def _committed(folder: Path) -> dict[str, Any]:
    """The record of a folder that a task has committed; {} if there is none, or a link in the folder."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        if not stat.S_ISDIR(folder.lstat().st_mode) or not stat.S_ISREG((folder / RECORD).lstat().st_mode):
            return {}
        if any(path.is_symlink() for path in folder.rglob("*")):
            return {}
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        return record if _is_record(record) else {}
    return {}


def _is_record(found: Any) -> bool:
    """Whether a line of a manifest, or the record of committed work, is one: it may come from anybody."""
    try:
        outputs = [output["name"] + output["hash"] for output in found.get("outputs", ())]
        texts = [found["input"], found["status"], *outputs, *([found["error"]["message"]] if "error" in found else [])]
        return all(isinstance(text, str) for text in texts)
    except (LookupError, TypeError, AttributeError):
        return False


def _facts(record: dict[str, Any]) -> list[Any]:
    """What makes two records of an input the same work."""
    return [record.get(name) for name in ("status", "hash", "mtime_ns", "outputs", "versions", "error")]


def _without(record: dict[str, Any], left_out: Sequence[str]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name not in left_out}


def _parsed(path: Path, left_out: Sequence[str] = ()) -> tuple[dict[str, Any] | None, dict[str, dict[str, Any]], int]:
    """Header, last record of each input, and the end of the last whole line."""
    header, records, end = None, {}, 0
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                break
            end += len(line)
            try:
                found = json.loads(line)
                if number == 1:
                    header = found if found["geokit_batch"] == FORMAT and found["recipe_hash"] else None
                elif _is_record(found):
                    records[found["input"]] = _without(found, left_out)
                else:
                    header = None
            except (ValueError, LookupError, TypeError):
                header = None
            if header is None:
                raise FileFormatError(f"{path}: line {number} is none of a batch's manifest; choose another --out")
    return header, records, end


def read_manifest(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Header of a manifest, and the last record of each input.

    Raises:
        FileAccessError: The file cannot be read.
        FileFormatError: It is no manifest.
    """
    try:
        header, records, _ = _parsed(path)
    except OSError as error:
        raise FileAccessError(f"{path}: cannot be read ({error.strerror}); name a manifest") from error
    if header is None:
        raise FileFormatError(f"{path}: holds no batch; name a manifest.jsonl that geokit batch has written")
    return header, records


def merge(paths: Sequence[Path], target: Path) -> dict[str, dict[str, Any]]:
    """Write one manifest of the records of several, sorted by input; of two of an input, one that is done stays.

    Raises:
        InputError: There are none, or they are of different recipes.
    """
    if not paths:
        raise InputError("--merge: no manifests are given; name those of the shards")
    merged: dict[str, dict[str, Any]] = {}
    first, _ = read_manifest(paths[0])
    for path in paths:
        header, records = read_manifest(path)
        if header["recipe_hash"] != first["recipe_hash"]:
            raise InputError(f"{path}: is of another recipe than {paths[0]}; merge manifests of one recipe")
        for source, record in records.items():
            if source not in merged or record["status"] == "done":
                merged[source] = record
    merged = {source: merged[source] for source in sorted(merged)}
    with atomic_path(target) as part, open(part, "w", encoding="utf-8") as file:
        file.writelines(json.dumps(line) + "\n" for line in ({**first, "shard": None}, *merged.values()))
    return merged


def write_failures(records: dict[str, dict[str, Any]], path: Path) -> int:
    """Write the inputs that are not done with their errors, separated by tabs; return how many there are.

    Backslashes are doubled, and what does not print is an escape sequence of Python: names may hold tabs and line ends.
    """
    failed = {source: record["error"]["message"] for source, record in sorted(records.items()) if "error" in record}
    rows = [(source, " ".join(message.split())) for source, message in failed.items()]
    with atomic_path(path) as part, open(part, "w", encoding="utf-8", errors="surrogateescape") as file:
        file.writelines("\t".join(printable(cell.replace("\\", "\\\\")) for cell in row) + "\n" for row in rows)
    return len(failed)
