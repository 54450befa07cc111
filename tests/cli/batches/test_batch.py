"""``geokit batch`` on this machine: killed and gone on with, poisoned files, limits, shards."""

from __future__ import annotations

import json
import os
import signal
import time
from collections import Counter
from pathlib import Path

import pytest

from geokit.cli.batch import _sources

pytestmark = pytest.mark.process

SAME = ("input", "status", "hash", "size", "outputs")


def _facts(records):
    return sorted([record.get(name) for name in SAME] for record in records)


def _children(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def test_what_a_batch_leaves(start, corners, recipe: Path, tmp_path: Path, records_in) -> None:
    sources, out = corners(3), tmp_path / "out"
    bad = tmp_path / "in" / "bad.obj"
    bad.write_text("f 1 2 9\n")
    listed = tmp_path / "list.txt"
    listed.write_text(f"{bad}\n\n{sources[0]}\n")
    done = start(recipe, *sources, "--files-from", listed, "--out", out, "--jobs", "2", "--json").end()
    assert done.returncode == 1, done.stderr
    told = json.loads(done.stdout)
    assert (told["files"], told["done"], told["failed"], told["outputs"]) == (4, 3, 1, 3)
    assert Counter(record["status"] for record in records_in(out / "manifest.jsonl")) == {"done": 3, "failed": 1}
    (line,) = (out / "failures.tsv").read_text().splitlines()
    assert line.startswith(f"{bad}\t{bad}: face 0")
    page = (out / "report.html").read_text()
    assert str(bad) in page
    assert "corner002.obj" in page
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["manifest.jsonl", "failures.tsv", "report.html", *(f"corner{number:03}.off" for number in range(3))]
    )
    # Again: nothing is left to do, until a failure is asked for again.
    before = (out / "manifest.jsonl").read_bytes()
    again = start(recipe, *sources, bad, "--out", out).end()
    assert (again.returncode, (out / "manifest.jsonl").read_bytes()) == (1, before)
    assert "4 of 4 files are done already" in again.stderr
    bad.write_text(sources[0].read_text())
    assert start(recipe, *sources, bad, "--out", out, "--retry-failed").end().returncode == 0
    assert (out / "bad.off").is_file()


@pytest.mark.parametrize("moment", [0, 1, 7])
def test_killed_and_gone_on_with(start, corners, recipe: Path, tmp_path: Path, records_in, moment: int) -> None:
    sources, out = corners(40), tmp_path / "out"
    manifest = out / "manifest.jsonl"
    first = start(recipe, *sources, "--out", out, "--jobs", "2")
    while not manifest.is_file() or len(manifest.read_bytes().splitlines()) < moment + 1:
        assert first.process.poll() is None
        time.sleep(0.002)
    children = _children(first.process.pid)
    first.kill()
    before = manifest.read_bytes()
    done = start(recipe, *sources, "--out", out, "--jobs", "2").end()
    assert done.returncode == 0, done.stderr
    # What was recorded stays as it is, and the rest is done once: no input is in the manifest twice (records_in).
    assert manifest.read_bytes().startswith(before[: before.rfind(b"\n") + 1])
    assert {record["input"] for record in records_in(manifest)} == set(map(str, sources))
    assert len(list(out.glob("*.off"))) == len(sources)
    assert not list(out.glob(".geokit*"))
    # The processes of the first have ended too.
    assert not [pid for pid in children if Path(f"/proc/{pid}/cmdline").is_file()
                and b"_batches" in Path(f"/proc/{pid}/cmdline").read_bytes()]  # fmt: skip


def test_processes_that_are_killed_are_started_again(start, corners, recipe, tmp_path, records_in) -> None:
    sources, out = corners(60), tmp_path / "out"
    batch = start(recipe, *sources, "--out", out, "--jobs", "2")
    killed = 0
    while batch.process.poll() is None and killed < 4:
        found = (out / "manifest.jsonl").is_file() and len((out / "manifest.jsonl").read_bytes().splitlines())
        children = _children(batch.process.pid)
        if found and found > 2 + 5 * killed and children:
            os.kill(children[0], signal.SIGKILL)
            killed += 1
        time.sleep(0.002)
    done = batch.end()
    assert done.returncode == 0, done.stderr
    assert killed
    records = records_in(out / "manifest.jsonl")
    assert {record["input"] for record in records} == set(map(str, sources))
    assert {record["status"] for record in records} == {"done"}


def test_a_file_that_kills_its_process_is_set_aside(start, corners, recipe, tmp_path, records_in) -> None:
    sources, out = corners(4), tmp_path / "out"
    poison = tmp_path / "in" / "poison.obj"
    poison.write_text(sources[0].read_text())
    done = start(recipe, poison, *sources, "--out", out, "--jobs", "1").end()
    assert done.returncode == 1, done.stderr
    statuses = {Path(record["input"]).name: record for record in records_in(out / "manifest.jsonl")}
    assert statuses.pop("poison.obj")["status"] == "set aside"
    assert {record["status"] for record in statuses.values()} == {"done"}
    (line,) = (out / "failures.tsv").read_text().splitlines()
    assert line == f"{poison}\t{poison}: its process ended by signal SIGKILL in 3 tries; it is set aside"


def test_a_process_may_not_have_more_memory_than_allowed(start, corners, tmp_path, records_in) -> None:
    sources, out, recipe = corners(1), tmp_path / "out", tmp_path / "dense.toml"
    recipe.write_text('[[step]]\nverb = "convert"\noutput = "{stem}.nvdb"\nvoxel-size = 0.001\nhalf-width = 40\n')
    done = start(recipe, *sources, "--out", out, "--task-memory", 600 << 20).end()
    assert done.returncode == 1, done.stderr
    (record,) = records_in(out / "manifest.jsonl")
    assert record["error"]["type"] == "DeviceMemoryError"
    assert "600 MiB of --task-memory" in record["error"]["message"]
    assert not list(out.glob("*.nvdb"))


def test_a_list_of_files_is_split_at_newlines_only(tmp_path) -> None:
    listed, names = tmp_path / "list.txt", ["/a\u2028b", "/c\u0085d", "/e\ff", "/g\rh", "/i\udce4j", "/k"]
    listed.write_bytes("\n".join([*names[:-1], "/k\r", ""]).encode("utf-8", "surrogateescape"))
    assert list(_sources([], listed)) == names


def test_an_interrupt_ends_all(start, corners, recipe: Path, tmp_path: Path) -> None:
    batch = start(recipe, *corners(200), "--out", tmp_path / "out", "--jobs", "2")
    while not list(tmp_path.glob("out/*.off")):
        assert batch.process.poll() is None
        time.sleep(0.01)
    children = _children(batch.process.pid)
    batch.process.send_signal(signal.SIGINT)
    done = batch.end()
    assert (done.returncode, done.stderr.splitlines()[-1]) == (130, "geokit: interrupted")
    assert children
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)


def test_shards_are_the_whole(start, corners, recipe: Path, tmp_path: Path, records_in) -> None:
    sources, parts = corners(9), tmp_path / "parts"
    assert start(recipe, *sources, "--out", tmp_path / "whole", "--jobs", "1").end().returncode == 0
    for number in (1, 2, 3):
        done = start(recipe, *sources, "--out", parts, "--jobs", "1", "--shard", f"{number}/3").end()
        assert done.returncode == 0, done.stderr
    manifests = sorted(parts.glob("manifest-*.jsonl"))
    assert len(manifests) == 3
    done = start("--merge", *manifests, "--out", parts / "all.jsonl").end()
    assert done.returncode == 0, done.stderr
    assert _facts(records_in(parts / "all.jsonl")) == _facts(records_in(tmp_path / "whole" / "manifest.jsonl"))
    assert (parts / "report-all.html").is_file()


def test_bad_arguments_are_named(start, corners, recipe: Path, tmp_path: Path) -> None:
    sources, out = corners(1), tmp_path / "out"
    twin = corners(1, "other")
    for arguments, words in [
        ((), ["RECIPE.toml: is missing"]),
        ((recipe,), ["no files are given"]),
        ((recipe, *sources, "--shard", "4/3"), ["--shard: '4/3'", "3/64"]),
        ((recipe, *sources, "--jobs", "0"), ["--jobs"]),
        ((recipe, *sources, "--task-memory", "0"), ["--task-memory"]),
        ((recipe, *sources, "--task-seconds", "0"), ["--task-seconds: 0 is no time", "above 0"]),
        ((recipe, *sources, *twin), ["corner000.off", "{folder}/{stem}"]),
        ((tmp_path / "none.toml", *sources), ["none.toml: no such file"]),
    ]:
        done = start(*arguments, "--out", out).end()
        assert done.returncode == 1, done.stderr
        assert all(word in done.stderr for word in words), done.stderr
    assert not out.exists()
