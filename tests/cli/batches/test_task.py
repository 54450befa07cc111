"""One file: its work is committed whole, once, and what went wrong is told."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path

import pytest

from geokit.cli._batches import task
from geokit.cli._batches.recipe import read_recipe
from geokit.cli._batches.task import DONE, OUTPUTS, RECORD, WORK, key_of, run_task
from geokit.cli._batches.worker import versions
from geokit.mesh import load

TWO = (
    '[[step]]\nverb = "convert"\noutput = "{stem}.ply"\nkeep = false\n\n'
    '[[step]]\nverb = "mesh transform"\noutput = "{folder}/{stem}.off"\nmove = [1, 0, 0]\n'
)


@pytest.fixture
def staging(tmp_path: Path) -> Path:
    for name in (WORK, DONE):
        (tmp_path / "out" / "staging" / name).mkdir(parents=True)
    return tmp_path / "out" / "staging"


def test_the_record_says_what_was_done(corners, recipe: Path, staging: Path) -> None:
    recipe.write_text(TWO)
    (source,) = corners(1)
    record = run_task(list(read_recipe(recipe).steps), str(source), staging)
    folder = staging / DONE / key_of(str(source))
    made = folder / OUTPUTS / "in" / "corner000.off"
    assert load(made).vertices[:, 0].tolist() == [1.0, 2.0, 1.0, 1.0]
    assert (record["status"], record["input"], record["versions"]) == ("done", str(source), versions())
    assert record["hash"] == hashlib.sha256(source.read_bytes()).hexdigest()
    hashed = hashlib.sha256(made.read_bytes()).hexdigest()
    assert record["outputs"] == [{"name": "in/corner000.off", "bytes": made.stat().st_size, "hash": hashed}]
    assert [step["verb"] for step in record["steps"]] == ["convert", "mesh transform"]
    assert record["steps"][0]["summary"]["faces"] == 4
    assert record["seconds"] > 0
    assert record["peak_bytes"] > 1 << 20
    assert json.loads((folder / RECORD).read_text()) == record
    assert list((staging / WORK).iterdir()) == []
    # The folder of the job is nowhere in it.
    assert str(staging) not in json.dumps(record)


def test_the_first_of_two_workers_stays(corners, recipe: Path, staging: Path) -> None:
    (source,) = corners(1)
    steps = list(read_recipe(recipe).steps)
    first = run_task(steps, str(source), staging)
    done = staging / DONE / key_of(str(source))
    # One that comes later does nothing, one that began before drops what it has done.
    assert run_task(steps, str(source), staging) == first
    read = Path.read_text
    with pytest.MonkeyPatch.context() as patch:
        calls: list[Path] = []

        def late(path: Path, *more: object, **options: object) -> str:
            calls.append(path)
            if len(calls) == 1:
                raise FileNotFoundError
            return read(path, *more, **options)  # type: ignore[arg-type]

        patch.setattr(Path, "read_text", late)
        assert run_task(steps, str(source), staging) == first
    assert calls == [done / RECORD] * 2
    assert list((staging / WORK).iterdir()) == []


def test_errors_are_kept(corners, recipe: Path, staging: Path, tmp_path: Path, monkeypatch) -> None:
    steps = list(read_recipe(recipe).steps)
    bad = tmp_path / "bad.obj"
    bad.write_text("v 0 0 0\nf 1 2 9\n")
    record = run_task(steps, str(bad), staging)
    assert (record["status"], record["error"]["type"]) == ("failed", "FileFormatError")
    assert (record["error"]["step"], record["error"]["verb"]) == (1, "convert")
    assert str(bad) in record["error"]["message"]
    assert "outputs" not in record
    assert "no such file" in run_task(steps, str(tmp_path / "none.obj"), staging)["error"]["message"]
    assert "format" in run_task(steps, str(recipe), staging)["error"]["message"]
    monkeypatch.setattr(task, "hash_of", lambda _: 1 / 0)
    (source,) = corners(1)
    assert "internal error: ZeroDivisionError" in run_task(steps, str(source), staging)["error"]["message"]


@pytest.mark.parametrize("name", ["fsync", "mkdir"])
def test_a_full_disk_is_no_fault_of_the_file(corners, recipe: Path, staging: Path, monkeypatch, name: str) -> None:
    (source,), steps = corners(1), list(read_recipe(recipe).steps)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, name, full)
    record = run_task(steps, str(source), staging)
    monkeypatch.undo()
    assert record["status"] == "no room"
    assert "No space left" in record["error"]["message"]
    assert str(staging.parent) in record["error"]["message"]
    assert [list((staging / name).iterdir()) for name in (WORK, DONE)] == [[], []]
