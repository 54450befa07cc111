"""From file to file comes what the calls in memory give, whole or in tiles; what cannot be read or written is named."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit import DeviceMemoryError, FileAccessError, FileFormatError, InputError
from geokit.formats.blocks.points import open_points
from geokit.formats.blocks.records import BLOCK_BYTES, RecordFile, append
from geokit.formats.columns import Columns
from geokit.points.streamed import columns, process_file, tiles
from tests.support.effort import of_all

CPU: dict[str, Any] = {"device": "cpu"}


@pytest.fixture
def in_tiles(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], dict[str, Any]]:
    """Leaves so few bytes that the points of a small cloud are many tiles, and blocks of a thousand points."""
    monkeypatch.setattr(process_file, "AT_A_TIME", 1000)

    def bounded(memory: int) -> dict[str, Any]:
        monkeypatch.setattr(process_file, "BYTES_AT_A_TIME", (1 << 28) - memory)
        return {"memory_limit": 1 << 28, **CPU}

    return bounded


def cloud(count: int = 12000) -> tuple[np.ndarray, Columns]:
    """A surface, a solid crowd, a few equal points and a stray one, in any order, with arrays."""
    rng = np.random.default_rng(5)
    ball = rng.normal(size=(count // 2, 3))
    ball *= 3.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate(
        [ball, 0.3 * rng.normal(size=(count // 2, 3)), np.full((40, 3), 0.125), [[90.0, -70.0, 8.0]]]
    )
    points = points[rng.permutation(len(points))] + [1e3, -5e4, 7.0]
    data = {
        "rgb": rng.integers(0, 256, (len(points), 3), dtype=np.uint8),
        "time": rng.random(len(points)),
        "class": rng.integers(-9, 9, len(points), dtype=np.int16),
    }
    return points, data


def in_memory(path: Path, points: np.ndarray, data: Columns, **how: Any) -> bytes:
    """The file that the calls in memory make."""
    if "voxel_size" in how:
        found = gk.points.downsample(points, voxel_size=how["voxel_size"], **CPU)
        points, data = found.points, {name: values[found.indices] for name, values in data.items()}
    if "normals" in how:
        planes = gk.points.normals(points, **{"orientation": "none", **how["normals"]}, **CPU)
        data = {**data, "normals": planes.normals, "curvature": planes.curvature}
    if "density" in how:
        data = {**data, "density": gk.points.density(points, **how["density"], **CPU)}
    gk.points.save(path, points, data=data)
    return path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"voxel_size": 0.21},
        {"normals": {}, "density": {"radius": 0.1}},
        {"normals": {"k": 7, "orientation": "viewpoint", "viewpoint": [1e3, -5e4, 0.0]}},
        {"voxel_size": 0.05, "normals": {"k": 12}, "density": {"radius": 0.3, "mass": 2.5}},
    ],
    ids=str,
)
@pytest.mark.parametrize("memory", [400_000, 8_000_000])
def test_the_file_is_that_of_the_calls_in_memory(
    how: dict[str, Any], memory: int, in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path
) -> None:
    """Byte for byte: points, order, arrays, and names."""
    if memory < 1_000_000 and "normals" in how:
        memory *= 8
    points, data = cloud()
    gk.points.save(tmp_path / "a.ply", points, data=data)
    found = gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **how, **in_tiles(memory))
    expected = in_memory(tmp_path / "c.ply", points, data, **how)
    assert (tmp_path / "b.ply").read_bytes() == expected
    assert found == (len(points), 0, len(gk.points.load(tmp_path / "c.ply")))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "b.ply", "c.ply"]


@pytest.mark.parametrize("size", [0.9, 40.0, 1e6])
def test_voxels_of_more_points_than_fit(size: float, in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path) -> None:
    points, data = cloud()
    gk.points.save(tmp_path / "a.ply", points, data=data)
    gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", voxel_size=size, **in_tiles(60_000))
    assert (tmp_path / "b.ply").read_bytes() == in_memory(tmp_path / "c.ply", points, data, voxel_size=size)


def test_neighborhoods_of_a_radius_have_the_same_points(
    in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path
) -> None:
    """Sums in another order: 2^-53 for each neighbor, of which there are up to 300."""
    points, _ = cloud()
    gk.points.save(tmp_path / "a.ply", points)
    how = {"normals": {"radius": 0.13}, "density": {"radius": 0.2, "kernel": "cubic_spline"}}
    gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **how, **in_tiles(3_000_000))
    found = gk.points.load(tmp_path / "b.ply").data
    planes = gk.points.normals(points, radius=0.13, orientation="none", **CPU)
    np.testing.assert_array_equal((found["normals"] == 0).all(axis=1), (planes.normals == 0).all(axis=1))
    np.testing.assert_allclose(found["curvature"], planes.curvature, rtol=0, atol=316 * 2.0**-53)
    expected = gk.points.density(points, radius=0.2, kernel="cubic_spline", **CPU)
    np.testing.assert_allclose(found["density"], expected, rtol=320 * 2.0**-53)
    apart = np.abs(np.einsum("ij,ij->i", found["normals"], planes.normals))
    assert (apart[planes.curvature > 0] > 1.0 - 1e-9).mean() > 0.999


@pytest.mark.parametrize("kind", [".las", ".laz"])
def test_las_files_go_through(kind: str, in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    points, data = cloud(4000)
    data = {
        "rgb": data["rgb"].astype(np.uint16),
        "intensity": np.arange(len(points)).astype(np.uint16),
        "own": data["time"],
    }
    gk.points.save(tmp_path / f"a{kind}", points, data=data)
    how = {"normals": {}, "voxel_size": 0.3}
    gk.points.process_file(tmp_path / f"a{kind}", tmp_path / f"b{kind}", **how, **in_tiles(2_000_000))
    read = gk.points.load(tmp_path / f"a{kind}")
    in_memory(tmp_path / f"c{kind}", read.points, dict(read.data), **how)
    found, expected = (gk.points.load(tmp_path / f"{name}{kind}") for name in "bc")
    np.testing.assert_array_equal(found.points, expected.points)
    assert list(found.data) == list(expected.data)
    for name, values in expected.data.items():
        np.testing.assert_array_equal(found.data[name], values)
    assert (tmp_path / f"b{kind}").stat().st_size == (tmp_path / f"c{kind}").stat().st_size


def raw(points: np.ndarray, count: int | None = None, more: str = "") -> bytes:
    header = f"ply\nformat binary_little_endian 1.0\n{more}element vertex {len(points) if count is None else count}\n"
    return f"{header}property float x\nproperty float y\nproperty float z\nend_header\n".encode() + points.tobytes()


def test_points_that_are_not_finite_are_named_or_left_out(tmp_path: Path) -> None:
    points = np.random.default_rng(1).random((50, 3)).astype(np.float32)
    points[[7, 20], [1, 2]] = np.nan, np.inf
    (tmp_path / "a.ply").write_bytes(raw(points))
    with pytest.raises(FileFormatError, match=r"a\.ply: point 7 is not finite .*finite_only=True"):
        gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **CPU)
    assert not (tmp_path / "b.ply").exists()
    found = gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", finite_only=True, normals={"k": 5}, **CPU)
    assert found == (50, 2, 48)
    kept = gk.points.load(tmp_path / "a.ply", finite_only=True).points
    assert (tmp_path / "b.ply").read_bytes() == in_memory(tmp_path / "c.ply", kept, {}, normals={"k": 5})


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points(count: int, tmp_path: Path) -> None:
    points = np.arange(3.0 * count, dtype=np.float32).reshape(count, 3)
    (tmp_path / "a.ply").write_bytes(raw(points))
    how = {"voxel_size": 0.5, "normals": {}, "density": {"radius": 1.0}}
    assert gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **how, **CPU).written_count == count
    expected = in_memory(tmp_path / "c.ply", points.astype(np.float64), {}, **how)
    assert (tmp_path / "b.ply").read_bytes() == expected


@pytest.mark.slow
def test_points_in_one_place(in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path) -> None:
    """As scanners write them for rays without an echo: they have no plane, and their voxel is theirs alone."""
    rng = np.random.default_rng(2)
    points = np.concatenate([np.zeros((4000, 3)), rng.random((2000, 3)) + 1.0])[rng.permutation(6000)]
    gk.points.save(tmp_path / "a.ply", points)
    for how in ({"normals": {"k": 9}}, {"voxel_size": 0.1}):
        gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **how, **in_tiles(500_000))
        assert (tmp_path / "b.ply").read_bytes() == in_memory(tmp_path / "c.ply", points, {}, **how)
    with pytest.raises(DeviceMemoryError, match=r"density: more than \d+ points lie within the radius of those near"):
        gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", density={"radius": 0.1}, **in_tiles(500_000))


@pytest.mark.slow
def test_many_neighbors_of_points_in_one_place(
    in_tiles: Callable[[int], dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer points there than neighbors are asked for, and more around them than fit."""
    monkeypatch.setattr(columns, "FEW", 4)
    points = np.concatenate([np.full((25, 3), 0.5), 0.5 + 0.01 * np.random.default_rng(2).normal(size=(250, 3))])
    gk.points.save(tmp_path / "a.ply", points)
    gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", normals={"k": 40}, **in_tiles(1120 * 60))
    assert (tmp_path / "b.ply").read_bytes() == in_memory(tmp_path / "c.ply", points, {}, normals={"k": 40})


def test_progress_and_a_file_onto_itself(tmp_path: Path) -> None:
    points, data = cloud(3000)
    gk.points.save(tmp_path / "a.ply", points, data=data)
    done: list[int] = []
    gk.points.process_file(
        tmp_path / "a.ply", tmp_path / "a.ply", voxel_size=0.2, progress=lambda at, of: done.append(at), **CPU
    )
    assert done == sorted(done)
    assert done[-1] == 100
    assert (tmp_path / "a.ply").read_bytes() == in_memory(tmp_path / "c.ply", points, data, voxel_size=0.2)


LIST = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int a\nend_header\n\0"
WRONG = {
    "text.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
    "short.ply": raw(np.zeros((2, 3), np.float32), 3),
    "order.ply": raw(np.zeros((0, 3), np.float32), 0, "element face 0\nproperty list uchar int vertex_indices\n"),
    "axes.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty char x\nend_header\n\0",
    "list.ply": LIST,
    "empty.ply": b"",
    "other.las": b"LASX" + bytes(400),
}


@pytest.mark.parametrize("name", WRONG)
def test_files_that_cannot_be_read_are_named(name: str, tmp_path: Path) -> None:
    if name.endswith(".las"):
        pytest.importorskip("laspy")
    path = tmp_path / name
    path.write_bytes(WRONG[name])
    with pytest.raises(FileFormatError, match=name) as error:
        gk.points.process_file(path, tmp_path / "a.ply", **CPU)
    assert len(str(error.value)) < 300
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_damaged_laz_is_named(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    points, _ = cloud(4000)
    gk.points.save(tmp_path / "a.laz", points)
    (tmp_path / "a.laz").write_bytes((tmp_path / "a.laz").read_bytes()[:-3000])
    with pytest.raises(FileFormatError, match=r"a\.laz"):
        gk.points.process_file(tmp_path / "a.laz", tmp_path / "b.ply", **CPU)
    assert [file.name for file in tmp_path.iterdir()] == ["a.laz"]


def test_bad_arguments_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, out = tmp_path / "a.ply", tmp_path / "b.ply"
    gk.points.save(good, np.random.default_rng(0).random((100, 3)))

    def refused(kind: type[Exception], text: str, *given: object, **how: object) -> None:
        with pytest.raises(kind, match=text):
            gk.points.process_file(*(given or (good, out)), **how, **CPU)

    refused(FileAccessError, "no such file", tmp_path / "c.ply", out)
    refused(InputError, r"\.csv' is not a streamed point format", tmp_path / "c.csv", out)
    refused(InputError, r"\.vtp' is not a streamed point format", good, tmp_path / "c.vtp")
    refused(FileAccessError, "does not exist", good, tmp_path / "none" / "c.ply")
    refused(InputError, "voxel_size", voxel_size=0.0)
    refused(InputError, "voxel_size: 1e-17 is too small for coordinates", voxel_size=1e-17)
    refused(InputError, "normals: .* is not a mapping", normals=16)
    refused(InputError, "normals: 'points' is none of its arguments", normals={"points": 1})
    refused(InputError, "orientation 'propagation' carries signs across", normals={"orientation": "propagation"})
    refused(InputError, "viewpoint: missing", normals={"orientation": "viewpoint"})
    refused(InputError, "k: 2", normals={"k": 2})
    refused(InputError, "density: radius is missing", density={})
    refused(InputError, "density: mass has several", density={"radius": 1.0, "mass": [1.0, 2.0]})
    refused(InputError, "radius", density={"radius": -1.0})
    refused(InputError, "finite_only", finite_only=1)
    refused(InputError, "memory_limit", memory_limit=1000)
    gk.points.save(tmp_path / "c.ply", [[-1e308, 0, 0], [1e308, 0, 0]])
    refused(InputError, "more than a float64 can hold", tmp_path / "c.ply", out, normals={})
    gk.points.save(tmp_path / "c.ply", np.zeros((5, 3)), data={"a" * 40: np.zeros(5)})
    if importlib.util.find_spec("laspy"):
        refused(InputError, "at most 32 ASCII letters", tmp_path / "c.ply", tmp_path / "b.las")
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=10))
    refused(FileAccessError, "GiB that are free there; use another disk")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "c.ply"]


KILLED = """
import sys
import numpy as np
import geokit as gk
from geokit.points.streamed import process_file
gk.points.save(sys.argv[1] + "/a.ply", np.random.default_rng(0).random((20000, 3)))
process_file.BYTES_AT_A_TIME = (1 << 28) - 1000000
source, target = sys.argv[1] + "/a.ply", sys.argv[1] + "/b.ply"
while True:
    gk.points.process_file(source, target, normals={}, memory_limit=1 << 28, device="cpu")
"""


@pytest.mark.slow
def test_a_killed_process_leaves_nothing_after_the_next_write(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stderr=subprocess.DEVNULL)
    # Folders may go while they are walked.
    while sum(name.startswith("tile-") for _, _, names in os.walk(tmp_path) for name in names) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert len(list(tmp_path.rglob("tile-*"))) > 1
    gk.points.process_file(tmp_path / "a.ply", tmp_path / "c.ply", voxel_size=0.3, **CPU)
    assert {file.name for file in tmp_path.iterdir()} <= {"a.ply", "b.ply", "c.ply"}


PEAK = """
import json, sys
import numpy as np
import geokit as gk
def size(name):
    return next(int(line.split()[1]) << 10 for line in open("/proc/self/status") if line.startswith(name + ":"))
gk.points.save(sys.argv[1] + "/warm.ply", np.random.default_rng(0).random((3000, 3)))
for how in map(json.loads, sys.argv[2:]):
    gk.points.process_file(sys.argv[1] + "/warm.ply", sys.argv[1] + "/warmed.ply", **how, device="cpu")
    open("/proc/self/clear_refs", "w").write("5")
    before = size("VmRSS")
    gk.points.process_file(sys.argv[1] + "/a.ply", sys.argv[1] + "/b.ply", **how, memory_limit=1 << 28, device="cpu")
    print(size("VmHWM") - before)
    gk.release_memory()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_stays_below_the_limit(tmp_path: Path) -> None:
    """A million points of a solid, where half as many again lie around a tile; two million need over 300 MB."""
    gk.points.save(tmp_path / "a.ply", np.random.default_rng(3).random((of_all(1_000_000, 2_000_000), 3)))
    ways = '{"voxel_size": 0.004}', '{"normals": {"k": 24}, "density": {"radius": 0.01}}'
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(tmp_path), *ways], capture_output=True, text=True, timeout=1800, check=False
    )
    assert done.returncode == 0, done.stderr
    peaks = [int(line) for line in done.stdout.splitlines()]
    assert len(peaks) == len(ways)
    assert max(peaks) < 1 << 28


@pytest.mark.slow
def test_wide_points_are_read_in_small_blocks(tmp_path: Path) -> None:
    """A header may declare points of 64 KiB each."""
    points = np.random.default_rng(0).random((500, 3))
    gk.points.save(tmp_path / "a.ply", points, data={"many": np.ones((500, 4000))})
    sizes = [len(block[0]) for block in open_points(tmp_path / "a.ply").blocks(1 << 17, finite_only=False)]
    assert sum(sizes) == 500
    assert max(sizes) * 4003 * 8 <= BLOCK_BYTES


def test_records_keep_any_name(tmp_path: Path) -> None:
    """An array called as a field of the records would be lost."""
    points, data = np.ones((3, 3)), {"points": np.arange(3), "data x": np.ones((3, 2))}
    kept = tiles.records_of(points, data)
    append(tmp_path / "a", kept)
    found = list(tiles.blocks_of(RecordFile(tmp_path / "a", kept.dtype, 3)))
    assert [len(block[0]) for block in found] == [0, 3]
    for name, values in data.items():
        np.testing.assert_array_equal(found[1][1][name], values)
