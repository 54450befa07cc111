"""The manifest of a batch, JSON lines: a header and a record of each file; and the folders of committed work.

Work is committed by its process (task.py), then its outputs are moved to their place, then its record is written, then
its folder goes. Each of these steps can be repeated, so a batch that is killed between two of them goes on from there.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import uuid
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from geokit.cli._batches.recipe import Recipe, output_names
from geokit.cli._batches.task import DONE, OUTPUTS, RECORD, WORK, key_of
from geokit.cli._batches.worker import versions
from geokit.core.files import atomic_path
from geokit.core.private_folder import remove_folder
from geokit.core.running.thread_placement import Pool
from geokit.errors import FileAccessError, FileFormatError, InputError

__all__ = ["Manifest", "merge", "read_manifest", "write_failures"]

FORMAT = 1
STAGING = ".geokit-batch"
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
        InputError: The folder holds the batch of another recipe, or another process writes it.
        FileAccessError: The folder cannot be made or written.
    """

    def __init__(self, folder: Path, recipe: Recipe, shard: tuple[int, int] | None) -> None:
        suffix = "" if shard is None else f"-{shard[0]}-of-{shard[1]}"
        self.folder, self.path = folder, folder / f"manifest{suffix}.jsonl"
        self.staging = folder / f"{STAGING}{suffix}"
        header = {"geokit_batch": FORMAT, "recipe": recipe.text, "recipe_hash": recipe.hash, "shard": shard}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.file = open(self.path, "a+b", buffering=0)  # noqa: SIM115, closed by close
        except OSError as error:
            raise FileAccessError(f"{folder}: cannot write there ({error.strerror}); choose another --out") from error
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.file.close()
            raise InputError(
                f"{self.path}: another batch is writing it; wait for it, or choose another --out"
            ) from error
        except OSError:  # the file system has no locks
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
                remove_folder(self.staging / WORK)
                for name in (WORK, DONE):
                    (self.staging / name).mkdir(parents=True, exist_ok=True)
                self.add(json.loads((left / RECORD).read_text()) for left in sorted((self.staging / DONE).iterdir()))
        except BaseException:
            self.__exit__(True)
            raise

    def __enter__(self) -> Manifest:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
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
        outputs = (self.folder / output["name"] for output in record.get("outputs", ()))
        return before == (found.st_size, found.st_mtime_ns) and all(output.is_file() for output in outputs)

    def check_outputs(self, recipe: Recipe, todo: Iterable[str]) -> None:
        """Refuse to replace files that this batch has not made.

        Raises:
            InputError: There is one.
        """
        for source in todo:
            record = self.records.get(source, {})
            own = {output["name"] for output in record.get("outputs", ())}
            for name in output_names(recipe, Path(source)):
                if name not in own and (self.folder / name).exists():
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
                if _facts(record) != _facts(self.records.get(record["input"], {})) or record["status"] != "done":
                    self.records[record["input"]] = _without(record, LEFT_OUT)
                    written.append(record)
            self._write(written)
            self._pool.map(self._drop, folders)

    def _place(self, record: dict[str, Any], folder: Path) -> bool:
        """Move outputs to their place; False if there is no work to be found."""
        if not folder.is_dir():
            return False
        for output in record.get("outputs", ()):
            target = self.folder / output["name"]
            target.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # moved before the batch was killed
                os.replace(folder / OUTPUTS / output["name"], target)
        return True

    def _drop(self, folder: Path) -> None:
        """Remove committed work: it leaves in one step, so that none without its record is ever found."""
        away = self.staging / WORK / f"{folder.name}-{uuid.uuid4().hex[:8]}"
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


def _facts(record: dict[str, Any]) -> list[Any]:
    """What makes two records of an input the same work."""
    return [record.get(name) for name in ("status", "hash", "outputs", "versions")]


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
                else:
                    records[found["input"]] = _without(found, left_out)
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
    """Write the inputs that are not done with their errors, separated by tabs; return how many there are."""
    failed = {source: record["error"]["message"] for source, record in sorted(records.items()) if "error" in record}
    with atomic_path(path) as part, open(part, "w", encoding="utf-8", errors="surrogateescape") as file:
        file.writelines(f"{source}\t{' '.join(message.split())}\n" for source, message in failed.items())
    return len(failed)
