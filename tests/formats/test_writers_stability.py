"""Writers on failing disks: a named error, the old file kept, nothing left behind, and the process lives on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from geokit import FileFormatError, mesh, points
from geokit.formats.table import FORMATS
from tests.support.all_writers import OLD, holds, place, writers
from tests.support.effort import of_all

ROOT = Path(__file__).resolve().parents[2]
TRIANGLE = mesh.TriangleMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]])


def _lines(folder, how):
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.all_writers", folder, how],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == ""  # libraries do not print either
    return [json.loads(line) for line in done.stdout.splitlines()]


def _failed(folder, line):
    # The voxels of an .mhd are a file of their own.
    names = line["name"], line["name"].replace(".mhd", ".raw")
    return line["outcome"].startswith(tuple(f"FileAccessError: {folder / name}: writing failed (" for name in names))


@pytest.mark.slow
def test_past_a_limit_on_file_sizes(tmp_path):
    lines = _lines(tmp_path, "limits")
    assert len(lines) == of_all(3, 6) * len(writers())
    for line in lines:
        assert _failed(tmp_path, line), line
        assert line["kept"], line
        assert line["left"] == [], line


@pytest.mark.slow
def test_in_a_folder_that_vanished(tmp_path):
    lines = _lines(tmp_path / "gone", "vanished")
    assert len(lines) == len(writers())
    for line in lines:
        assert line["outcome"].startswith(f"FileAccessError: {tmp_path / 'gone' / line['name']}: the folder"), line


@pytest.fixture
def disk(tmp_path):
    """A file system of 64 KiB, and a function that makes it read-only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"a file system cannot be mounted here: {made.stderr.strip()}")
    yield folder, lambda: subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
    subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_on_a_full_disk_and_on_a_read_only_one(disk):
    folder, make_read_only = disk
    for name in writers():
        place(folder / name, b"")
    # Files of no length take no room: the two largest formats keep an old file.
    for name in ("mesh.vtp", "volume_none.nvdb"):
        place(folder / name, OLD)
    for line in _lines(folder, "plain"):
        # What writes more than its result asks for room first.
        refused = line["name"].startswith("processed") and line["outcome"].endswith("use another disk")
        assert refused or _failed(folder, line), line
        assert line["left"] == [], line
    make_read_only()
    for line in _lines(folder, "plain"):
        assert line["outcome"].startswith(f"FileAccessError: {folder / line['name']}: cannot write there (Read-o"), line
    for name in writers():
        assert holds(folder / name, OLD if name in ("mesh.vtp", "volume_none.nvdb") else b"")


def _sizes(target):
    files = sorted(target.rglob("*")) if target.is_dir() else [target]
    return [(str(file.relative_to(target)), file.stat().st_size) for file in files]


# A forked process for each path, which writes it again and again; how it ended. Nothing has written before the fork.
_KILLED = """
import os, sys
from pathlib import Path
from tests.support.all_writers import writers
made = writers()
for line in sys.stdin:
    target = Path(line.rstrip("\\n"))
    process = os.fork()
    while not process:
        print(os.getpid(), flush=True)
        made[target.name](target)
    print("ended", os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def killed():
    """Kills a process some time after its third save of a path has begun."""
    with subprocess.Popen(
        [sys.executable, "-c", _KILLED], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True,
    ) as process:  # fmt: skip

        def kill(target, seconds):
            print(target, file=process.stdin, flush=True)
            number, again, _ = (process.stdout.readline() for _ in range(3))
            assert number == again
            time.sleep(seconds)
            os.kill(int(number), signal.SIGKILL)
            while not (line := process.stdout.readline()).startswith("ended"):
                assert line == number
            assert line == f"ended {-signal.SIGKILL}\n"

        yield kill
        process.stdin.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    of_all(
        ["mesh.vtp", "volume_zip.zarr"],
        ["mesh.vtp", "mesh.usdc", "volume_zip.vdb", "volume_zip.nvdb", "volume_zip.zarr"],
    ),
)
def test_killed_writers_leave_a_whole_file_and_the_next_save_removes_their_rest(tmp_path, killed, name):
    target = tmp_path / name
    write = writers()[name]
    write(target)
    whole = _sizes(target)
    for round_ in range(6):
        killed(target, 0.004 * round_)
        assert _sizes(target) == whole
        write(target)
        assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.mesh])
def test_meshes_under_names_in_no_encoding(tmp_path, kind):
    folder = tmp_path / "caf\udce9"
    folder.mkdir()
    target = os.fsencode(folder / f"mod\udce8le{kind}")
    mesh.save(target, TRIANGLE)
    if FORMATS[kind].module == "usd":
        with pytest.raises(FileFormatError, match="UTF-8"):
            mesh.load(target)
    else:
        assert len(mesh.load(target).faces) == 1


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.mesh])
def test_meshes_that_have_their_names_from_such_files(tmp_path, kind):
    image = mesh.Texture("a.png", b"\x89PNG")
    named = mesh.TriangleMesh(
        TRIANGLE.vertices,
        TRIANGLE.faces,
        name="mod\udce8le",
        face_data={"material": [0]},
        materials=[mesh.Material("m", None, image)],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some hold no materials
        mesh.save(os.fsencode(tmp_path / f"mod\udce8le{kind}"), named)
        mesh.save(tmp_path / f"a{kind}", named)
    mesh.save(tmp_path / f"b{kind}", mesh.TriangleMesh(named.vertices, named.faces, name=named.name))
    assert len(mesh.load(tmp_path / f"b{kind}").faces) == 1
    again = mesh.load(tmp_path / f"a{kind}")
    assert len(again.faces) == 1
    if FORMATS[kind].materials:
        assert again.materials[0].texture.data == image.data


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.points])
def test_points_under_names_in_no_encoding(tmp_path, kind):
    target = os.fsencode(tmp_path / f"mod\udce8le{kind}")
    points.save(target, TRIANGLE.vertices)
    assert len(points.load(target)) == 3
