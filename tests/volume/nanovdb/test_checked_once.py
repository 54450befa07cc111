"""A grid's offsets are checked once: by its reader, or before the first use of a volume made from raw bytes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import geokit
from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.sphere_volumes import sphere
from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.errors import FileFormatError, GeokitError, InputError
from geokit.native import _openvdb
from geokit.volume import load, save
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb import checks
from geokit.volume.nanovdb.header import TREE_OFFSET, aligned_buffer, info_of, tree_header
from geokit.volume.tree.leaves import leaves_of
from geokit.volume.tree.typed_tree import tree_of

with_openvdb = pytest.mark.skipif(not native.available(), reason="built without OpenVDB")


@pytest.fixture
def checked(monkeypatch):
    """Buffers that check_grid has gone through, whoever called it; and those that the extension has."""
    seen = []
    check_root = checks._check_root  # once in each check_grid, and called by nothing else

    def counted(grid):
        seen.append(grid.root.buffer)
        return check_root(grid)

    monkeypatch.setattr(checks, "_check_root", counted)
    if native.available():
        extension = _openvdb._extension()
        check = extension.check

        def counted_check(buffer):
            seen.append(buffer)
            return check(buffer)

        monkeypatch.setattr(extension, "check", counted_check)
    return seen


def use_everything(volume):
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (5000, 3))
    for order in (0, 1, 2):
        geokit.volume.sample(volume, points, order=order, device="cpu")
    geokit.volume.raycast(volume, points - [20.0, 0.0, 0.0], np.tile([1.0, 0.0, 0.0], (5000, 1)), device="cpu")
    geokit.mesh.from_volume(volume, device="cpu")
    geokit.volume.dilate(volume, 1)
    geokit.volume.to_dense(volume, bounds=[[0, 0, 0], [3, 3, 3]], device="cpu")
    volume.quantize("fp8")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".nvdb", pytest.param(".vdb", marks=with_openvdb)])
@pytest.mark.parametrize("trusted", [False, True])
def test_a_file_is_checked_once_whatever_is_done_with_it(tmp_path, checked, kind, trusted):
    path = tmp_path / f"sphere{kind}"
    save(path, sphere(12.0))
    checked.clear()
    volume = load(path, trusted=trusted)
    assert len(checked) == 1
    assert checked[0] is volume.nanovdb
    use_everything(volume)
    save(tmp_path / "again.nvdb", volume)
    assert sum(buffer is volume.nanovdb for buffer in checked) == 1


def test_raw_bytes_are_checked_once_and_before_their_first_use(checked):
    source = sphere(12.0)
    volume = SparseVolume(source.nanovdb, source.info)
    assert not checked
    use_everything(volume)
    assert sum(buffer is volume.nanovdb for buffer in checked) == 1


def test_channels_are_read_from_a_grid_that_was_checked_once(checked):
    volume = IndexGrid("onindex", [("density", "float"), ("heat", "double")]).volume
    for channel in ("density", "heat", 0):
        geokit.volume.sample(volume, np.zeros((1, 3)), channel=channel, device="cpu")
    assert geokit.volume.channel_names(volume) == ["density", "heat"]
    assert sum(buffer is volume.nanovdb for buffer in checked) == 1


@with_openvdb
def test_whoever_reads_through_the_bridge_gets_checked_buffers(tmp_path, checked):
    save(tmp_path / "sphere.vdb", sphere(12.0))
    checked.clear()
    (grid,) = native.read_vdb(tmp_path / "sphere.vdb")
    assert [buffer is grid.nanovdb for buffer in checked] == [True]


@with_openvdb
@pytest.mark.parametrize("harm", ["short", "offset", "count"])
def test_what_a_subverted_worker_hands_back_is_refused(tmp_path, monkeypatch, harm):
    path = tmp_path / "sphere.vdb"
    save(path, sphere(12.0))
    unchecked = _openvdb._read_in_worker

    def harmed(*arguments):
        descriptions, (buffer,) = unchecked(*arguments)
        buffer = damaged(buffer, harm)
        return descriptions, [buffer]

    monkeypatch.setattr(_openvdb, "_read_in_worker", harmed)
    with pytest.raises(FileFormatError, match=r"sphere\.vdb"):
        load(path)


def damaged(buffer, harm):
    copied = aligned_buffer(len(buffer))
    copied[:] = buffer
    if harm == "short":
        return copied[:100]
    if harm == "offset":
        tree_header(copied)["node_offset"][0] = 1 << 40
    elif harm == "count":
        tree_header(copied)["node_count"][1] += 1
    else:
        lower = TREE_OFFSET + int(tree_header(copied)["node_offset"][1])
        slots = np.flatnonzero(np.unpackbits(copied[lower + 544 : lower + 1056], bitorder="little"))
        copied[lower + 1088 + 8 * slots[0] :][:8].view("<i8")[0] += 32
    return copied


USES = {
    "sample": lambda volume: geokit.volume.sample(volume, np.zeros((1, 3)), device="cpu"),
    "raycast": lambda volume: geokit.volume.raycast(volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu"),
    "from_volume": lambda volume: geokit.mesh.from_volume(volume, device="cpu"),
    "tree": tree_of,
    "leaves": leaves_of,
    "gradient_field": geokit.volume.gradient_field,
    "offset": lambda volume: geokit.volume.offset(volume, 1.0),
    "quantize": lambda volume: volume.quantize("fp8"),
    "id": lambda volume: volume.id("cpu"),
}


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["offset", "count", "child"])
@pytest.mark.parametrize("use", USES)
def test_damaged_bytes_are_refused_by_each_use(use, harm):
    source = sphere(12.0)
    volume = SparseVolume(damaged(source.nanovdb, harm), source.info)
    for _ in range(2):  # a refused grid is not taken for a checked one
        with pytest.raises(GeokitError):
            USES[use](volume)
    with pytest.raises(InputError):
        save("never.nvdb", volume)


def test_another_buffer_is_checked_though_the_first_was(checked):
    volume = SparseVolume(sphere(12.0).nanovdb, sphere(12.0).info)
    volume.id("cpu")
    other = dataclasses.replace(volume, nanovdb=damaged(volume.nanovdb, "count"), _uploads={})
    with pytest.raises(FileFormatError):
        other.id("cpu")
    assert checked


def test_a_cleared_cache_is_filled_again(checked):
    grid = TypedGrid("float").volume
    volume = SparseVolume(grid.nanovdb, info_of(grid.nanovdb))
    geokit.volume.raycast(volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu")
    first = geokit.volume.raycast(volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu")
    volume._cache.clear()
    again = geokit.volume.raycast(volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu")
    np.testing.assert_array_equal(first.t, again.t)
    assert len(checked) == 2
