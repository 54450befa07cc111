"""The manifest: wherever a batch is killed, what was done is recorded once and its outputs are in place."""

from __future__ import annotations

import errno
import itertools
import json
import os
from pathlib import Path
from typing import Any

import pytest

from geokit.cli._batches import manifest as manifest_module
from geokit.cli._batches.manifest import GONE, STAGING, Manifest, merge, read_manifest, write_failures
from geokit.cli._batches.recipe import read_recipe
from geokit.cli._batches.task import DONE, OUTPUTS, RECORD, WORK, key_of
from geokit.errors import FileAccessError, FileFormatError, InputError
from tests.support.effort import of_all
from tests.support.interrupts import interrupted

PARTS = ("manifest.py", "shutil.py", "thread_placement.py", "interrupts.py", "contextlib.py")


def _record(source: Path, status: str = "done") -> dict[str, Any]:
    found = source.stat()
    facts = {"input": str(source), "status": status, "size": found.st_size, "mtime_ns": found.st_mtime_ns, "hash": "h"}
    return {
        **facts,
        **({"outputs": [{"name": f"{source.stem}.off", "bytes": 1, "hash": "o"}]} if status == "done" else {}),
    }


def _commit(staging: Path, record: dict[str, Any]) -> None:
    """What a worker leaves."""
    folder = staging / DONE / key_of(record["input"])
    (folder / OUTPUTS).mkdir(parents=True)
    for output in record.get("outputs", ()):
        (folder / OUTPUTS / output["name"]).write_text("x")
    (folder / RECORD).write_text(json.dumps(record))


class Killed(BaseException):
    pass


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_call_is_gone_on_from(tmp_path, corners, recipe, records_in) -> None:
    (source,), read, number = corners(1), read_recipe(recipe), 0

    def block() -> None:
        with Manifest(out, read, None) as manifest:
            _commit(manifest.staging, _record(source))
            manifest.add([{**_record(source), "worker": "w"}])

    # Files with the steps; that of a worker, in pathlib.py, is not among them.
    for number in itertools.count(0, of_all(13, 1)):
        out = tmp_path / str(number)
        going_on = interrupted(number, block, PARTS)
        with Manifest(out, read, None) as manifest:
            done = manifest.is_done(str(source), False)
        assert sorted(path.name for path in out.iterdir()) == (["corner000.off"] if done else []) + [
            "manifest.jsonl"
        ], number
        assert len(records_in(out / "manifest.jsonl")) == done, number
        if not going_on:
            break
    assert done
    assert number > 100


@pytest.mark.parametrize(
    "moment", ["before anything", "before a move", "after a move", "before a record", "after it", "in its removal"]
)
def test_killed_at_any_moment(tmp_path, corners, recipe, records_in, monkeypatch, moment: str) -> None:
    (source,), read, out = corners(1), read_recipe(recipe), tmp_path / "out"

    def kill(*_: object, **__: object) -> None:
        raise Killed

    def remove_some_and_kill(folder: Path, **_: object) -> None:
        (folder / RECORD).unlink()
        raise Killed

    replace = os.replace

    def replace_and_kill(*paths: Path) -> None:
        replace(*paths)
        raise Killed

    def first() -> None:
        with Manifest(out, read, None) as manifest, monkeypatch.context() as patch:
            _commit(manifest.staging, _record(source))
            if moment == "before anything":
                kill()
            if moment.endswith("a move"):
                patch.setattr(os, "replace", kill if moment == "before a move" else replace_and_kill)
            elif moment == "before a record":
                patch.setattr(manifest, "_write", kill)
            else:
                patch.setattr(manifest_module.shutil, "rmtree", kill if moment == "after it" else remove_some_and_kill)
            manifest.add([{**_record(source), "worker": "w"}])

    with pytest.raises(Killed):
        first()
    with Manifest(out, read, None) as again:
        assert again.is_done(str(source), retry=True)
    assert [record["input"] for record in records_in(out / "manifest.jsonl")] == [str(source)]
    assert (out / "corner000.off").read_text() == "x"
    assert sorted(path.name for path in out.iterdir()) == ["corner000.off", "manifest.jsonl"]


def test_a_line_that_was_not_ended_is_dropped(tmp_path, corners, recipe, records_in) -> None:
    sources, read, out = corners(2), read_recipe(recipe), tmp_path / "out"
    with Manifest(out, read, None) as first:
        _commit(first.staging, _record(sources[0]))
        first.add([_record(sources[0])])
    whole = (out / "manifest.jsonl").read_bytes()
    for end in (len(whole) - 1, whole.index(b"\n") + 5, 7):
        (out / "manifest.jsonl").write_bytes(whole[:end])
        with Manifest(out, read, None) as again:
            assert not again.is_done(str(sources[0]), retry=False)
        assert records_in(out / "manifest.jsonl") == []


def test_work_that_comes_twice_is_recorded_once(tmp_path, corners, recipe, records_in) -> None:
    (source,), out = corners(1), tmp_path / "out"
    with Manifest(out, read_recipe(recipe), None) as manifest:
        for seconds in (1.0, 2.0):  # a worker that was thought lost, and the one in its place
            _commit(manifest.staging, _record(source))
            manifest.add([{**_record(source), "seconds": seconds}] * 2)
    assert [record["seconds"] for record in records_in(out / "manifest.jsonl")] == [1.0]


def test_a_failure_that_was_recorded_when_the_batch_was_killed_is_not_recorded_again(
    tmp_path, corners, recipe, records_in
) -> None:
    (source,), read, out = corners(1), read_recipe(recipe), tmp_path / "out"
    record = {**_record(source, "failed"), "error": {"message": "is bad"}}
    killed = Manifest(out, read, None)
    killed.add([{**record, "worker": "w"}])
    _commit(killed.staging, record)
    killed.__exit__(Killed())
    with Manifest(out, read, None) as again:
        assert again.is_done(str(source), retry=False)
        assert len(records_in(again.path)) == 1
        os.utime(source, ns=(0, 0))
        again.add([{**_record(source, "failed"), "error": {"message": "is bad"}}])
        assert again.is_done(str(source), retry=False)  # touched, and looked at again: that is kept


def test_what_has_changed_is_done_again(tmp_path, corners, recipe) -> None:
    sources, out = corners(2), tmp_path / "out"
    with Manifest(out, read_recipe(recipe), None) as manifest:
        _commit(manifest.staging, _record(sources[0]))
        manifest.add([_record(sources[0]), _record(sources[1], "failed")])
        assert [manifest.is_done(str(source), retry=False) for source in sources] == [True, True]
        assert [manifest.is_done(str(source), retry=True) for source in sources] == [True, False]
        sources[1].write_text("v 1 2 3\n")
        assert not manifest.is_done(str(sources[1]), retry=False)
        (out / "corner000.off").unlink()
        assert not manifest.is_done(str(sources[0]), retry=False)


def test_files_of_others_are_not_replaced(tmp_path, corners, recipe) -> None:
    (source,), read, out = corners(1), read_recipe(recipe), tmp_path / "out"
    with Manifest(out, read, None) as manifest:
        (out / "corner000.off").write_text("mine")
        with pytest.raises(InputError, match=r"corner000\.off: exists already.*--out.*--force"):
            manifest.check_outputs([str(source)], force=False)
        with pytest.raises(InputError, match="another batch is writing it"):
            Manifest(out, read, None)


def test_a_folder_of_another_recipe(tmp_path, recipe) -> None:
    out = tmp_path / "out"
    with Manifest(out, read_recipe(recipe), None):
        pass
    recipe.write_text(recipe.read_text() + "tolerance = 0.5\n")
    with pytest.raises(InputError, match=r"of another recipe.*--out"):
        Manifest(out, read_recipe(recipe), None)
    (out / "manifest.jsonl").write_text("{}\n")
    with pytest.raises(FileFormatError, match="line 1 is none"):
        Manifest(out, read_recipe(recipe), None)


def test_no_folder_and_no_room(tmp_path, corners, recipe, monkeypatch) -> None:
    (source,), read = corners(1), read_recipe(recipe)
    with pytest.raises(FileAccessError, match=r"cannot write there.*--out"):
        Manifest(source / "out", read, None)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def add() -> None:
        with Manifest(tmp_path / "out", read, None) as manifest, monkeypatch.context() as patch:
            _commit(manifest.staging, _record(source))
            patch.setattr(os, "replace", full)
            manifest.add([_record(source)])

    with pytest.raises(FileAccessError, match=r"out: writing failed .No space left"):
        add()
    with Manifest(tmp_path / "out", read, None) as manifest:
        assert manifest.is_done(str(source), retry=False)


def test_manifests_of_shards_merge(tmp_path, corners, recipe) -> None:
    sources, read = corners(4), read_recipe(recipe)
    for number in (1, 2):
        with Manifest(tmp_path / "out", read, (number, 2)) as manifest:
            manifest.add([_record(source, "failed") for source in sources[number - 1 :: 2]])
    paths = [tmp_path / "out" / f"manifest-{number}-of-2.jsonl" for number in (2, 1)]
    merged = merge(paths, tmp_path / "all.jsonl")
    header, records = read_manifest(tmp_path / "all.jsonl")
    assert list(records) == list(map(str, sources)) == list(merged)
    assert header["shard"] is None
    recipe.write_text(recipe.read_text() + "tolerance = 0.5\n")
    with Manifest(tmp_path / "other", read_recipe(recipe), None):
        pass
    with pytest.raises(InputError, match="of another recipe"):
        merge([*paths, tmp_path / "other" / "manifest.jsonl"], tmp_path / "all.jsonl")
    with pytest.raises(InputError, match="no manifests"):
        merge([], tmp_path / "all.jsonl")
    with pytest.raises(FileAccessError, match="cannot be read"):
        merge([tmp_path / "none.jsonl"], tmp_path / "all.jsonl")
    (tmp_path / "empty.jsonl").write_text("")
    with pytest.raises(FileFormatError, match="holds no batch"):
        merge([tmp_path / "empty.jsonl"], tmp_path / "all.jsonl")


def test_failures_are_listed_with_their_error(tmp_path: Path) -> None:
    records = {"/b": {"error": {"message": "b is\n bad"}}, "/a": {"error": {"message": "a is"}}, "/c": {}}
    assert write_failures(records, tmp_path / "failures.tsv") == 2
    assert (tmp_path / "failures.tsv").read_text() == "/a\ta is\n/b\tb is bad\n"


def test_what_does_not_print_is_escaped_in_the_list_of_failures(tmp_path: Path) -> None:
    names = ["/a\tb", "/c\nd", "/e\\f", "/g\x1b[31m", "/h\u2028i", "/j\udce4k", "/l m"]
    records = {name: {"error": {"message": f"{name}: is bad"}} for name in names}
    assert write_failures(records, tmp_path / "failures.tsv") == len(names)
    lines = (tmp_path / "failures.tsv").read_bytes().decode("utf-8", "surrogateescape").split("\n")
    cells = [line.split("\t")[0] for line in lines[:-1]]
    assert cells == ["/a\\tb", "/c\\nd", "/e\\\\f", "/g\\x1b[31m", "/h\\u2028i", "/j\udce4k", "/l m"]
    assert all(len(line.split("\t")) == 2 for line in lines[:-1])


@pytest.mark.parametrize("name", ["", WORK, DONE, GONE])
def test_a_link_in_place_of_a_folder_of_the_batch_is_refused(tmp_path, recipe, name: str) -> None:
    read, out, victim = read_recipe(recipe), tmp_path / "out", tmp_path / "victim"
    (victim / "sub").mkdir(parents=True)
    (victim / "sub" / "keep.txt").write_text("mine")
    link = out / STAGING / name
    link.parent.mkdir(parents=True, mode=0o700)
    link.symlink_to(victim)
    with pytest.raises(InputError, match=rf"{link.name}: is a link.*remove it"):
        Manifest(out, read, None)
    assert (victim / "sub" / "keep.txt").read_text() == "mine"
    assert len(list(victim.iterdir())) == 1


@pytest.mark.parametrize("name", ["manifest.jsonl", "failures.tsv", "report.html"])
def test_a_link_in_place_of_a_file_of_the_batch_is_refused(tmp_path, recipe, name: str) -> None:
    victim, out = tmp_path / "keep.txt", tmp_path / "out"
    victim.write_text("mine, without a line end")
    out.mkdir()
    (out / name).symlink_to(victim)
    with pytest.raises(InputError, match=rf"{name}: is a link.*remove it"):
        Manifest(out, read_recipe(recipe), None)
    assert victim.read_text() == "mine, without a line end"


@pytest.mark.parametrize(
    "fault", ["..", "absolute", "other name", "none", "own", "link", "link above", "record", "no text", "other key"]
)
def test_committed_work_that_the_recipe_does_not_make_is_done_again(tmp_path, corners, recipe, fault: str) -> None:
    (source,), read, out, victim = corners(1), read_recipe(recipe), tmp_path / "out", tmp_path / "victim"
    victim.mkdir()
    (victim / "keep.txt").write_text("mine")
    (victim / "corner000.off").write_text("mine too")
    names = {"..": "../victim/keep.txt", "absolute": f"{victim}/keep.txt", "other name": "b.off", "own": "report.html"}
    record = _record(source)
    folder = out / STAGING / DONE / key_of(str(source))
    (folder / OUTPUTS).mkdir(parents=True)
    for made in (out / STAGING, out / STAGING / DONE):
        made.chmod(0o700)
    (folder / OUTPUTS / "corner000.off").write_text("forged")
    if fault in names:
        record["outputs"].append({"name": names[fault], "bytes": 1, "hash": "o"})
        if fault != "other name":
            (folder / OUTPUTS / "keep.txt").write_text("forged")
    if fault == "none":
        record["outputs"] = []
    if fault == "link":
        (folder / OUTPUTS / "more").symlink_to(victim)
    if fault == "no text":
        record["outputs"][0]["name"] = 3
    if fault == "other key":
        folder = folder.rename(folder.with_name("0" * 24))
    if fault == "link above":
        (folder / OUTPUTS / "corner000.off").unlink()
        (folder / OUTPUTS).rmdir()
        (folder / OUTPUTS).symlink_to(victim)
    (folder / RECORD).write_text("[" * 9000 if fault == "record" else json.dumps(record))
    with Manifest(out, read, None) as manifest:
        assert manifest.records == {}
        assert not manifest.is_done(str(source), retry=False)
        assert list((manifest.staging / DONE).iterdir()) == []
    assert sorted(path.name for path in out.iterdir()) == ["manifest.jsonl"]
    assert {path.name: path.read_text() for path in victim.iterdir()} == {
        "keep.txt": "mine",
        "corner000.off": "mine too",
    }


def test_outputs_do_not_follow_a_link_out_of_the_folder(tmp_path, corners, recipe) -> None:
    recipe.write_text(recipe.read_text().replace("{stem}", "{folder}/{stem}"))
    (source,), read, out, victim = corners(1), read_recipe(recipe), tmp_path / "out", tmp_path / "victim"
    victim.mkdir()
    (out / "inside").mkdir(parents=True)
    with Manifest(out, read, None) as manifest:
        (out / "in").symlink_to(victim)
        for force in (False, True):
            with pytest.raises(InputError, match=r"out/in: leads to .*victim, out of .*out; remove that link"):
                manifest.check_outputs([str(source)], force)
        record = {**_record(source), "outputs": [{"name": "in/corner000.off", "bytes": 1, "hash": "o"}]}
        (manifest.staging / DONE / key_of(str(source)) / OUTPUTS / "in").mkdir(parents=True)
        with pytest.raises(InputError, match="remove that link"):
            manifest.add([record])
        (out / "in").unlink()
        (out / "in").symlink_to("inside")
        manifest.check_outputs([str(source)], force=False)
    assert list(victim.iterdir()) == []


def test_done_without_an_output_is_not_done(tmp_path, corners, recipe) -> None:
    (source,), out = corners(1), tmp_path / "out"
    with Manifest(out, read_recipe(recipe), None) as manifest:
        manifest.records[str(source)] = {**_record(source), "outputs": []}
        assert not manifest.is_done(str(source), retry=False)


def test_a_manifest_of_another_shape_is_named(tmp_path, recipe) -> None:
    with Manifest(tmp_path, read_recipe(recipe), None) as manifest:
        path = manifest.path
    header = path.read_text()
    for line in (
        "[]",
        '{"input": "/a"}',
        '{"input": "/a", "status": 3}',
        '{"input": "/a", "status": "done", "outputs": [1]}',
    ):
        path.write_text(f"{header}{line}\n")
        with pytest.raises(FileFormatError, match="line 2 is none"):
            read_manifest(path)


def test_tasks_of_a_killed_batch_keep_their_folder_until_the_batch_that_goes_on_ends(tmp_path, recipe) -> None:
    out, read = tmp_path / "out", read_recipe(recipe)
    folder = out / STAGING / WORK / ".geokit-1-2" / "task"
    killed = Manifest(out, read, None)
    folder.mkdir(parents=True)
    killed.__exit__(Killed())
    with Manifest(out, read, None):
        assert folder.is_dir()
    assert [path.name for path in out.iterdir()] == ["manifest.jsonl"]
