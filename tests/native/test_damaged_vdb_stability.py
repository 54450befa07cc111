"""Damaged .vdb files: a named error or a clean load, never a crash, a hang or a leftover.

The worker may die of a file; the process that asked must not, and must have nothing left of it.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from geokit import native
from geokit.errors import FileAccessError, FileFormatError, UnsupportedGridError, WorkerError
from geokit.native import VdbGrid, _openvdb, _worker
from tests.support.effort import of_all

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB"),
]

# A mutant that keeps the worker busy for longer is stopped, which is one of the allowed ends.
TIME_LIMIT = 5.0
# Far more than the sample needs, far less than a flipped length can ask for.
MEMORY_LIMIT = 1 << 30


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Small two-grid files by compression."""
    folder = tmp_path_factory.mktemp("samples")
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    field = native.mesh_to_level_set(vertices, faces, voxel_size=0.1)
    grids = [
        VdbGrid(field, {"name": "first", "author": "geokit", "frame": 7}),
        VdbGrid(field, {"name": "second"}),
    ]
    contents = {}
    for compression in ("blosc", "zip", "none"):
        path = folder / f"{compression}.vdb"
        native.write_vdb(path, grids, compression=compression)
        contents[compression] = path.read_bytes()
    return contents


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker program reads all files."""
    monkeypatch.setattr(_openvdb, "FIRST_FILES", sys.maxsize)


@pytest.fixture(params=["program", "server"])
def either(program: None, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker program reads all files, or a fork of the process that is kept for small ones does."""
    if request.param == "server":
        monkeypatch.setattr(_openvdb, "FIRST_FILES", 0)


@pytest.fixture
def spool_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which every spool of this test is made, so that a leftover shows."""
    root = tmp_path / "spool"
    root.mkdir()
    monkeypatch.setattr(_worker, "spool_folders", lambda file_size: [str(root)])
    return root


def outcome(path: Path) -> str:
    """How reading ended; any other exception fails the test."""
    start = time.monotonic()
    try:
        grids = native.read_vdb(path, time_limit=TIME_LIMIT, memory_limit=MEMORY_LIMIT)
    except FileFormatError as error:
        result = "refused" if str(path) in str(error) else "refused without naming the file"
    except UnsupportedGridError:
        # A byte of a type's name or of the transform's kind can turn one valid name into another.
        result = "unsupported"
    else:
        for grid in grids:
            # What a reader relies on still holds: the tree is whole.
            native.volume_to_mesh(grid.nanovdb)
        result = "loaded"
    assert time.monotonic() - start < TIME_LIMIT + 40.0
    return result


@pytest.mark.usefixtures("either")
@pytest.mark.slow
@pytest.mark.parametrize("compression", ["blosc", "zip", "none"])
def test_every_truncation_is_refused(
    samples: dict[str, bytes], tmp_path: Path, spool_root: Path, compression: str
) -> None:
    content = samples[compression]
    path = tmp_path / "short.vdb"
    steps = np.linspace(0, len(content) - 2, of_all(6, 24)).astype(int)
    sizes = sorted({0, 1, 7, 8, 30, 60, 100, 200, len(content) - 1, *steps})
    for size in sizes:
        path.write_bytes(content[:size])
        assert outcome(path) == "refused", f"{size} of {len(content)} bytes"
    assert list(spool_root.iterdir()) == []


@pytest.mark.usefixtures("either")
@pytest.mark.slow
@pytest.mark.parametrize("compression", ["blosc", "zip", "none"])
@pytest.mark.parametrize("seed", range(of_all(1, 4)))
def test_flipped_bytes(
    samples: dict[str, bytes], tmp_path: Path, spool_root: Path, compression: str, seed: int
) -> None:
    content = samples[compression]
    rng = np.random.default_rng(seed)
    ends = []
    for mutant in range(12):
        data = bytearray(content)
        # Half of the mutants are hit in the headers, where lengths and offsets are.
        reach = len(data) if mutant % 2 else 1500
        for at in rng.integers(0, reach, size=int(rng.integers(1, 6))):
            data[at] = int(rng.integers(0, 256))
        path = tmp_path / f"flipped{mutant}.vdb"
        path.write_bytes(data)
        ends.append(outcome(path))
    # The mutants would prove nothing if none of them hurt.
    assert "refused" in ends
    assert list(spool_root.iterdir()) == []


@pytest.mark.usefixtures("either")
def test_overwritten_blocks(samples: dict[str, bytes], tmp_path: Path, spool_root: Path) -> None:
    content = samples["blosc"]
    rng = np.random.default_rng(11)
    for mutant in range(8):
        data = bytearray(content)
        start = int(rng.integers(100, len(data) - 600))
        data[start : start + 512] = rng.bytes(512) if mutant % 2 else bytes([255 * (mutant % 4 == 0)]) * 512
        path = tmp_path / "blocks.vdb"
        path.write_bytes(data)
        outcome(path)
    assert list(spool_root.iterdir()) == []


@pytest.mark.usefixtures("either")
@pytest.mark.parametrize("content", [b"", b"#!/bin/sh\necho hello\n" * 50, b"\0" * 5000, b"\xff" * 5000])
def test_files_that_are_none(tmp_path: Path, spool_root: Path, content: bytes) -> None:
    path = tmp_path / "other.vdb"
    path.write_bytes(content)
    assert outcome(path) == "refused"
    with pytest.raises(FileFormatError, match=r"other\.vdb"):
        native.inspect_vdb(path)
    assert list(spool_root.iterdir()) == []


@pytest.mark.slow
def test_inspecting_damaged_files(samples: dict[str, bytes], tmp_path: Path) -> None:
    content = samples["blosc"]
    rng = np.random.default_rng(23)
    path = tmp_path / "headers.vdb"
    refused = 0
    for _ in range(15):
        data = bytearray(content)
        for at in rng.integers(0, 1500, size=4):
            data[at] = int(rng.integers(0, 256))
        path.write_bytes(data)
        try:
            native.inspect_vdb(path, time_limit=TIME_LIMIT, memory_limit=MEMORY_LIMIT)
        except (FileFormatError, UnsupportedGridError):
            refused += 1
    assert refused > 0


@pytest.mark.usefixtures("either")
def test_a_file_without_grids(samples: dict[str, bytes], tmp_path: Path, spool_root: Path) -> None:
    content = bytearray(samples["none"])
    # The count of grids stands in front of the first descriptor: the length of its name, then the name.
    at = content.index(b"first") - 8
    assert content[at] == 2
    content[at] = 0
    path = tmp_path / "none.vdb"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="no grids"):
        native.read_vdb(path)
    assert list(spool_root.iterdir()) == []


@pytest.mark.usefixtures("either")
def test_sound_files_still_load(samples: dict[str, bytes], tmp_path: Path, spool_root: Path) -> None:
    for name, content in samples.items():
        path = tmp_path / f"{name}.vdb"
        path.write_bytes(content)
        first, second = native.read_vdb(path)
        assert first.metadata == {"author": "geokit", "frame": 7}
        assert np.array_equal(first.nanovdb[672:], second.nanovdb[672:])
    assert list(spool_root.iterdir()) == []


def stub_worker(folder: Path, body: str) -> Path:
    """A program in the worker's place, to show what the caller makes of its end."""
    worker = folder / "worker"
    worker.write_text(f"#!{sys.executable}\nimport os, signal, sys, time\n{textwrap.dedent(body)}\n")
    worker.chmod(0o755)
    return worker


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "match"),
    [
        ("time.sleep(60)", "took more than"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL"),
        ("print('{'); sys.exit(0)", "status 0"),
        ("print('{}'); sys.exit(1)", "status 1"),
        ("sys.exit(66)", "status 66"),
    ],
)
def test_every_end_of_the_worker_has_a_name(
    samples: dict[str, bytes],
    tmp_path: Path,
    spool_root: Path,
    monkeypatch: pytest.MonkeyPatch,
    body: str,
    match: str,
) -> None:
    path = tmp_path / "fine.vdb"
    path.write_bytes(samples["blosc"])
    monkeypatch.setattr(_openvdb, "_worker_path", lambda: stub_worker(tmp_path, body))
    start = time.monotonic()
    with pytest.raises(WorkerError if match == "SIGKILL" else FileFormatError, match=match):
        native.read_vdb(path, time_limit=1.5)
    assert time.monotonic() - start < 40.0  # the worker sleeps for 60
    assert list(spool_root.iterdir()) == []


@pytest.mark.usefixtures("either")
@pytest.mark.slow
def test_memory_limit(tmp_path: Path, spool_root: Path) -> None:
    """A file of a few kilobytes that grows a thousandfold is stopped at the limit, and loads with more."""
    path = tmp_path / "bomb.vdb"
    field = native.mesh_to_level_set(
        np.array([[0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]], float),
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        voxel_size=0.1,
    )
    native.write_vdb(path, [VdbGrid(field, {})])
    assert len(native.read_vdb(path)) == 1
    with pytest.raises(FileFormatError, match="memory_limit"):
        native.read_vdb(path, memory_limit=len(field) // 4)
    assert list(spool_root.iterdir()) == []


def test_cpu_limit_of_the_worker_itself(samples: dict[str, bytes], tmp_path: Path) -> None:
    """The worker does not outlive its limits when nobody watches it, and leaves no core file."""
    path = tmp_path / "fine.vdb"
    path.write_bytes(samples["blosc"])
    worker = _openvdb._worker_path()
    done = subprocess.run(
        [worker, "inspect", str(1 << 30), "0", path], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=30
    )
    # Zero seconds of CPU: killed by the kernel, or done before its first tick.
    assert done.returncode in (0, -signal.SIGXCPU, -signal.SIGKILL)
    assert not list(tmp_path.glob("core*"))
    assert subprocess.run([worker], stderr=subprocess.DEVNULL, timeout=30).returncode == 2


def test_full_spool_falls_back_and_then_is_named(
    samples: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fine.vdb"
    path.write_bytes(samples["blosc"])
    worker = _openvdb._worker_path()
    full, roomy = tmp_path / "full", tmp_path / "roomy"
    full.mkdir()
    roomy.mkdir()
    # Says what the worker says when the file system is full, for the first folder only.
    body = f"""
        if sys.argv[5].startswith({str(full)!r}):
            print('{{"error": {{"kind": "spool", "message": "No space left on device", "names": []}}}}')
            sys.exit(1)
        os.execv({str(worker)!r}, [{str(worker)!r}] + sys.argv[1:])
    """
    monkeypatch.setattr(_openvdb, "_worker_path", lambda: stub_worker(tmp_path, body))
    monkeypatch.setattr(_worker, "spool_folders", lambda file_size: [str(full), str(roomy)])
    assert len(native.read_vdb(path)) == 2
    monkeypatch.setattr(_worker, "spool_folders", lambda file_size: [str(full)])
    with pytest.raises(FileAccessError, match="No space left"):
        native.read_vdb(path)
    assert list(full.iterdir()) == list(roomy.iterdir()) == []


def test_arrays_outlive_the_spool(samples: dict[str, bytes], tmp_path: Path, spool_root: Path) -> None:
    path = tmp_path / "fine.vdb"
    path.write_bytes(samples["zip"])
    worker_grids = native.read_vdb(path)
    assert list(spool_root.iterdir()) == []
    trusted_grids = native.read_vdb(path, trusted=True)
    path.unlink()
    for ours, theirs in zip(worker_grids, trusted_grids, strict=True):
        assert np.array_equal(ours.nanovdb, theirs.nanovdb)
        assert ours.nanovdb.flags.writeable


def test_the_spool_of_a_killed_process_is_removed_by_the_next_read(
    samples: dict[str, bytes], tmp_path: Path, spool_root: Path
) -> None:
    path = tmp_path / "fine.vdb"
    path.write_bytes(samples["zip"])
    code = textwrap.dedent(
        f"""
        import time
        from geokit import native
        from geokit.native import _worker
        _worker.spool_folders = lambda file_size: [{str(spool_root)!r}]
        _worker.run_worker = lambda *arguments, **options: print(flush=True) or time.sleep(60)
        native.read_vdb({str(path)!r})
        """
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.kill()
    assert len(list(spool_root.iterdir())) == 1
    native.read_vdb(path)
    assert list(spool_root.iterdir()) == []


def test_default_folders_prefer_shared_memory() -> None:
    folders = _worker.spool_folders(1000)
    assert folders[-1] == os.path.realpath(folders[-1]) or os.path.isdir(folders[-1])
    if os.path.isdir("/dev/shm") and shutil.disk_usage("/dev/shm").free > 10_000:
        assert folders[0] == "/dev/shm"
    # More than any memory: the disk comes first.
    assert _worker.spool_folders(1 << 60) == folders[-1:]
