"""One file: its work is committed whole, once, and what went wrong is told."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from geokit import native
from geokit.cli._batches import task
from geokit.cli._batches.recipe import read_recipe
from geokit.cli._batches.task import DONE, OUTPUTS, RECORD, WORK, key_of, run_task
from geokit.cli._batches.worker import versions
from geokit.core.base.private_folder import LOCK
from geokit.errors import InputError, WorkerError
from geokit.formats.reader import server
from geokit.mesh import box, load, save

RECIPE = '[[step]]\nverb = "convert"\noutput = "{stem}.off"\n'
TWO = (
    '[[step]]\nverb = "convert"\noutput = "{stem}.ply"\nkeep = false\n\n'
    '[[step]]\nverb = "mesh transform"\noutput = "{folder}/{stem}.off"\nmove = [1, 0, 0]\n'
)


@pytest.fixture
def staging(tmp_path: Path) -> Iterator[Path]:
    for name in (WORK, DONE):
        (tmp_path / "out" / "staging" / name).mkdir(parents=True)
    yield tmp_path / "out" / "staging"
    task._held.close()
    task._place.clear()


def _left(staging: Path) -> list[Path]:
    """What tasks left in their private folders."""
    return [path for path in (staging / WORK).glob("*/*") if path.name != LOCK]


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
    assert _left(staging) == []
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
    assert _left(staging) == []


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
    assert [_left(staging), list((staging / DONE).iterdir())] == [[], []]


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("can't start new thread"),
        BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)),
        server.Ended(False, os.strerror(errno.EAGAIN)),
    ],
    ids=["thread", "process", "reader"],
)
def test_a_step_that_gets_no_thread_or_process_is_no_fault_of_the_file(
    corners, recipe: Path, staging: Path, monkeypatch, error: Exception
) -> None:
    (source,), steps = corners(1), list(read_recipe(recipe).steps)

    def refuse(_: object) -> str:
        try:
            raise error
        except type(error):
            raise WorkerError("what a reader makes of it") from None

    monkeypatch.setattr(task, "hash_of", refuse)
    record = run_task(steps, str(source), staging)
    assert (record["status"], record["error"]["type"]) == ("lost", "WorkerError")
    assert "cannot be started" in record["error"]["message"]
    assert "ulimit -u" in record["error"]["message"]
    assert list((staging / DONE).iterdir()) == []


def test_a_reader_that_was_killed_is_another_matter(corners, recipe: Path, staging: Path, monkeypatch) -> None:
    def killed(_: object) -> str:
        raise WorkerError("killed from outside") from server.Ended(True, -9)

    monkeypatch.setattr(task, "hash_of", killed)
    record = run_task(list(read_recipe(recipe).steps), str(corners(1)[0]), staging)
    assert (record["status"], record["error"]["message"]) == ("failed", "killed from outside")


def test_a_task_whose_folder_goes_away_is_lost_and_its_file_does_not_fail(
    corners, recipe: Path, staging: Path, monkeypatch
) -> None:
    (source,), steps = corners(1), list(read_recipe(recipe).steps)
    read = task.hash_of

    def go_away(path: Path) -> str:
        if path == source:
            (staging / WORK).rename(staging / "gone")
        return read(path)

    monkeypatch.setattr(task, "hash_of", go_away)
    for _ in range(2):  # in the middle, and before it begins
        record = run_task(steps, str(source), staging)
        assert (record["status"], record["input"]) == ("lost", str(source))
        assert f"{staging}: others remove what tasks write there" in record["error"]["message"]
    assert list((staging / DONE).iterdir()) == []
    (staging / WORK).mkdir()
    monkeypatch.undo()
    assert run_task(steps, str(source), staging)["status"] == "done"


def test_a_commit_that_another_process_was_faster_with_and_that_is_recorded_already(
    corners, recipe: Path, staging: Path, monkeypatch
) -> None:
    def taken(*_: object) -> None:
        raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY))

    monkeypatch.setattr(Path, "rename", taken)
    record = run_task(list(read_recipe(recipe).steps), str(corners(1)[0]), staging)
    assert record["status"] == "lost"


def test_a_name_that_leads_out_fails_and_so_does_a_step_without_output(
    corners, recipe: Path, staging: Path, monkeypatch
) -> None:
    recipe.write_text(TWO.replace("{stem}.ply", "{stem}/a.ply"))
    (source,) = corners(1)
    hidden = source.with_name("...obj")
    hidden.write_text(source.read_text())
    record = run_task(list(read_recipe(recipe).steps), str(hidden), staging)
    assert record["status"] == "failed"
    assert "its output would be '../a.ply', which leads out" in record["error"]["message"]
    monkeypatch.setattr(task, "_command", lambda _: lambda _: 0)
    record = run_task(list(read_recipe(recipe).steps), str(source), staging)
    assert record["error"]["message"] == f"{source}: the step made no corner000/a.ply; change its output in the recipe"


def test_a_recipe_in_a_folder_with_braces(corners, staging: Path, tmp_path: Path) -> None:
    folder = tmp_path / "{x}"
    folder.mkdir()
    (folder / "other.obj").write_text(corners(1)[0].read_text())
    recipe = folder / "recipe.toml"
    recipe.write_text(f'[[step]]\nverb = "info"\nfiles = ["other.obj"]\n\n{RECIPE}files = ["{{input}}"]\n')
    source = corners(1, "{stem}")[0].rename(tmp_path / "{stem}" / "{0}.obj")
    record = run_task(list(read_recipe(recipe).steps), str(source), staging)
    assert record["status"] == "done", record
    assert [output["name"] for output in record["outputs"]] == ["{0}.off"]


TRADES = """\
[[step]]
verb = "wrap"
output = "{stem}-wrap.ply"
tolerance = 0.05
gap = "200mm"
from-unit = "m"
device = "cpu"

[[step]]
verb = "boolean union"
files = ["{previous}", "tool.obj"]
output = "{stem}-union.ply"

[[step]]
verb = "hollow"
output = "{stem}-hollow.ply"
wall = 0.1
drain = ["-0.02,0.25,0.25", "0.25,-0.02,0.25"]
drain-radius = 0.04
device = "cpu"

[[step]]
verb = "compare"
files = ["{input}", "{step2}"]
limit = 0.05
device = "cpu"

[[step]]
verb = "compare"
files = ["{input}", "{step2}"]
output = "{stem}.csv"
"""


@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
def test_trades_are_steps(corners, recipe: Path, staging: Path) -> None:
    (source,) = corners(1)
    save(recipe.with_name("tool.obj"), box((0.15, 0.15, 0.15), center=(1.0, 0.0, 0.0)))
    recipe.write_text(TRADES)
    record = run_task(list(read_recipe(recipe).steps), str(source), staging)
    assert record["status"] == "done", record
    wrapped, united, hollow, compared, written = (step["summary"] for step in record["steps"])
    assert wrapped["deviation"] <= 0.05
    assert 1 / 6 < united["volume"] < 1 / 3
    assert hollow["closed_cavities"] == 0
    assert -0.05 < compared["deviation_max"] < 0.0  # all of the input lies inside of its wrap
    assert compared["beyond_limit"] > 0.0  # and deep inside of the tool
    assert written["output"] == "corner000.csv"
    assert [each["name"][9:] for each in record["outputs"]] == ["-hollow.ply", "-union.ply", "-wrap.ply", ".csv"]


def test_lengths_are_checked_before_a_file_is_read(corners, recipe: Path) -> None:
    corners(1)
    recipe.write_text(TRADES.partition("\n\n")[0].replace("200mm", "wide"))
    with pytest.raises(InputError, match=r"recipe.toml:5: step 1 \(wrap\): gap: .*'wide' is no length"):
        read_recipe(recipe)
