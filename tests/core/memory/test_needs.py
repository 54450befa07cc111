"""What operations need: refused before they start, and stated where memory runs out in them."""

from __future__ import annotations

import errno
import functools
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core.memory import available_memory, needs
from geokit.errors import DeviceMemoryError, InputError
from geokit.render import _view
from tests.support.public_calls import public_names

MIB = 1 << 20


def failing(error: Exception):
    @needs.needs(lambda size, **_: size)
    def work(size: int, *, scale: float = 1.0) -> float:
        """A docstring."""
        raise error

    return work


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("Failed to allocate 4096 bytes on device 'cpu'"),
        RuntimeError("std::bad_alloc"),
        SystemError("error return without exception set"),
        RuntimeError("can't start new thread"),
        RuntimeError("Warp CUDA error 101: invalid device ordinal (in function scan_device, scan.cu:97)"),
        ImportError("libx.so: failed to map segment from shared object"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    ],
)
def test_each_way_of_running_out_has_one_name(error) -> None:
    with pytest.raises(DeviceMemoryError, match=r"work: needs about 3 MiB, of \d+ MiB free") as raised:
        failing(error)(3 * MIB, scale=2.0)
    assert raised.value.need == 3 * MIB
    assert raised.value.__cause__ is error
    assert pickle.loads(pickle.dumps(raised.value)).need == 3 * MIB


def test_memory_that_ends_while_it_is_asked_for_has_the_same_name(monkeypatch) -> None:
    def no_line() -> int:
        raise MemoryError

    monkeypatch.setattr(available_memory, "_free", no_line)
    with pytest.raises(DeviceMemoryError, match="work: needs about 3 MiB, of 0 MiB free"):
        failing(MemoryError())(3 * MIB)


@pytest.mark.parametrize("error", [InputError("x"), ValueError("allocate"), RuntimeError("x"), OSError(2, "x")])
def test_other_errors_pass(error) -> None:
    with pytest.raises(type(error)) as raised:
        failing(error)(1)
    assert raised.value is error


@pytest.mark.parametrize("dtype", [wp.uint8, wp.float64])
def test_a_limit_of_numbers_is_no_lack_of_memory(dtype) -> None:
    """Warp numbers the rows of an array in 31 bits: free memory does not help, and it is not asked for."""

    @needs.needs(lambda: 1 << 40, late=True)
    def work() -> None:
        wp.empty(1 << 31, dtype=dtype, device="cpu")

    with pytest.raises(InputError, match=r"^work: a single array .* more than 2\^31 - 1 rows; give it less at a time"):
        work()


def test_a_library_without_room_is_named_by_the_cause() -> None:
    error = RuntimeError("Failed to load the shared library 'warp.so'")
    error.__cause__ = OSError("warp.so: failed to map segment from shared object")
    with pytest.raises(DeviceMemoryError, match="work: needs more memory"):
        failing(error)(1)


def test_a_part_says_what_the_whole_needs() -> None:
    with pytest.raises(DeviceMemoryError, match=r"^part \(work needs about 3 MiB in all\)$") as raised:
        failing(DeviceMemoryError("part", need=MIB))(3 * MIB)
    assert raised.value.need == 3 * MIB
    with pytest.raises(DeviceMemoryError, match=r"^part$"):
        failing(DeviceMemoryError("part", need=4 * MIB))(3 * MIB)


def test_refused_before_it_starts(monkeypatch) -> None:
    monkeypatch.setattr(available_memory, "available_host", lambda: 40 * MIB)
    work = failing(ValueError("started"))
    with pytest.raises(DeviceMemoryError, match="work: needs about 30 MiB, of 40 MiB free"):
        work(30 * MIB)
    with pytest.raises(ValueError, match="started"):
        work(20 * MIB)
    with pytest.raises(ValueError, match="started"):  # an argument that the estimate cannot read
        work("30")
    assert (work.__name__, work.__doc__) == ("work", "A docstring.")


def test_late_estimates_delay_nothing() -> None:
    @needs.needs(lambda values: 1 / 0, late=True)
    def work(values: int) -> int:
        return values

    assert work(3) == 3


def test_every_public_operation_names_its_lack_of_memory() -> None:
    """Each public function that computes is decorated, so that no raw MemoryError leaves it."""
    # Plain data, whose methods forward to functions.
    plain = {"volume.SparseVolume", "volume.AdaptiveSDF"}
    missing = []
    for name in sorted(public_names()):
        door, _, path = name.partition(".")
        entry = functools.reduce(getattr, path.split("."), getattr(gk, door))
        if door not in ("mesh", "volume", "points", "render") or name in plain:
            continue
        if name.endswith(".show"):  # of geokit.render
            continue
        if name.startswith("volume.SparseVolume.") and hasattr(gk.volume, entry.__name__):
            continue
        if not hasattr(entry.__init__ if isinstance(entry, type) else entry, "_geokit_bytes"):
            missing.append(name)
    assert missing == []
    assert hasattr(_view.show, "_geokit_bytes")


CHILD = """
import resource, sys
import numpy as np
from geokit.core.memory.available_memory import available_host
with open("/proc/self/statm") as file:
    mapped = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (mapped + (100 << 20),) * 2)
free = available_host()
assert 90 << 20 < free <= 100 << 20, free
kept = np.empty(60 << 20, np.uint8)
assert 30 << 20 < available_host() < 41 << 20, available_host()
"""


@pytest.mark.process
def test_address_space_counts() -> None:
    done = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("version", [1, 2])
def test_control_groups_count(tmp_path: Path, version: int) -> None:
    own = tmp_path / ("memory/a/b" if version == 1 else "a/b")
    own.mkdir(parents=True)
    limit, use = (
        ("memory.limit_in_bytes", "memory.usage_in_bytes") if version == 1 else ("memory.max", "memory.current")
    )
    for folder, most in ((own, "max" if version == 2 else str(2**63 - 4096)), (own.parent, "1000")):
        (folder / limit).write_text(most)
        (folder / use).write_text("700")
        (folder / "memory.stat").write_text("anon 600\ninactive_file 50\n")
    groups = tmp_path / "cgroup"
    groups.write_text("3:cpu:/x\n4:memory:/a/b\n" if version == 1 else "0::/a/b\n")
    found = available_memory._control_groups.__wrapped__(groups, tmp_path)
    assert [files[0].parent for files in found] == [own.parent]  # the other has no limit
    assert min(available_memory._rest_of(*files) for files in found) == 350
    assert available_memory._control_groups.__wrapped__(tmp_path / "none", tmp_path) == []


def test_far_points_have_a_name() -> None:
    corners = np.vstack([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(corners, faces), device="cpu")
    grid = gk.points.NeighborGrid(corners, device="cpu")
    far = np.zeros((3000, 3))
    far[2000] = [0.0, -1e151, 0.0]
    for rows in (far, far[1990:2010]):
        row = int(np.flatnonzero(rows[:, 1])[0])
        for ask in (surface.closest_point, surface.signed_distance, surface.winding_number, surface.furthest_point):
            with pytest.raises(InputError, match=rf"points: row {row} is farther than 1e\+150 from the origin"):
                ask(rows)
        with pytest.raises(InputError, match=rf"queries: row {row} is farther than 1e\+150"):
            grid.knn(rows, 2)
    with pytest.raises(InputError, match=r"points: they lie farther than 1e\+150"):
        gk.points.NeighborGrid(far, device="cpu").knn(far[:5])
    near = np.array([[9e149, 0.0, 0.0]])
    np.testing.assert_allclose(surface.closest_point(near).distance, 9e149, rtol=1e-14)
    np.testing.assert_allclose(grid.knn(near, 1).distance, [[9e149]], rtol=1e-14)


@pytest.mark.parametrize("far", [1e10, 1e16, 1e20, 1e100])
def test_far_points_are_outside(far: float) -> None:
    directions = np.random.default_rng(3).normal(size=(200, 3))
    rows = far * directions / np.linalg.norm(directions, axis=1)[:, None]
    corners = np.vstack([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(corners, faces), device="cpu")
    assert surface.sign_method == "pseudonormal"
    assert not surface.contains(rows).any()
    np.testing.assert_allclose(surface.signed_distance(rows).distance, far, rtol=1.0 / min(far, 1e14) * 2)
