"""Grids larger than an array of warp: their bytes behind the first 2^31 - 1 count like the others."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit.volume import SparseVolume
from geokit.volume.nanovdb import grid_array
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import TREE_OFFSET, aligned_buffer, grid_header, tree_header
from geokit.volume.nanovdb.nodes import grid_nodes
from tests.support.devices import DEVICES

CPU = {"device": "cpu"}
POINTS = np.random.default_rng(5).uniform(-1.6, 1.6, (20_000, 3))


@pytest.fixture(scope="module")
def torus() -> SparseVolume:
    return gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.04, half_width=6, **CPU)


@pytest.fixture(scope="module")
def behind(torus: SparseVolume) -> SparseVolume:
    """The torus with its leaves behind 2^31 bytes; the gap is memory that nobody writes."""
    buffer = torus.nanovdb
    leaf = grid_nodes(buffer).leaf
    assert leaf.end == len(buffer)
    gap = (1 << 31) + (1 << 20)
    moved = aligned_buffer(len(buffer) + gap, zeroed=True)
    moved[: leaf.begin] = buffer[: leaf.begin]
    moved[leaf.begin + gap :] = buffer[leaf.begin :]
    grid_header(moved)["grid_size"] += gap
    grid_header(moved)["blind_offset"] += gap
    tree_header(moved)["node_offset"][0] += gap
    lower = grid_nodes(moved).lower
    node, slot, _ = lower.links()
    lower.child_offsets[node, slot] += gap
    check_grid(moved, "moved")
    assert TREE_OFFSET + int(tree_header(moved)["node_offset"][0]) > 1 << 31
    return SparseVolume(moved, torus.info)


@pytest.mark.parametrize("order", range(4))
def test_samples_and_gradients(order: int, torus: SparseVolume, behind: SparseVolume) -> None:
    # Twice: after enough queries a table of leaves answers them.
    for _ in range(2):
        np.testing.assert_array_equal(
            behind.sample(POINTS, order=order, **CPU), torus.sample(POINTS, order=order, **CPU)
        )
    if order:
        np.testing.assert_array_equal(
            behind.gradient(POINTS, order=order, **CPU), torus.gradient(POINTS, order=order, **CPU)
        )


def test_rays_states_and_surfaces(torus: SparseVolume, behind: SparseVolume) -> None:
    directions = -POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    for _ in range(2):
        found, expected = (one.raycast(POINTS, directions, **CPU) for one in (behind, torus))
        assert np.isfinite(expected.t).sum() > 1000
        np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_array_equal(behind.active_at(POINTS, **CPU), torus.active_at(POINTS, **CPU))
    made, same = gk.mesh.from_volume(behind, **CPU), gk.mesh.from_volume(torus, **CPU)
    np.testing.assert_array_equal(made.vertices, same.vertices)
    np.testing.assert_array_equal(made.faces, same.faces)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_arrays_that_show_the_first_bytes_only(
    device: str, torus: SparseVolume, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = gk.mesh.torus()
    values = gk.volume.active_voxels(torus).values * 2.0
    given = {"voxel_size": 0.04, "half_width": 6, "device": device}

    def answers() -> list[np.ndarray]:
        made = gk.volume.from_mesh(mesh, **given)
        doubled = gk.volume.with_values(made, values)
        return [
            made.nanovdb,
            made.sample(POINTS, device=device),
            gk.volume.quantize(made, "fp8").nanovdb,
            gk.volume.renormalize(made, device=device).nanovdb,
            doubled.nanovdb,
            doubled.sample(POINTS, device=device),
        ]

    expected = answers()
    monkeypatch.setattr(grid_array, "LARGEST_ARRAY", 5000)
    for found, same in zip(answers(), expected, strict=True):
        np.testing.assert_array_equal(found, same)


@pytest.mark.parametrize("size", [1, 4999, 5000, 5001, 10_000, 12_345])
@pytest.mark.parametrize("device", DEVICES)
def test_copies_in_parts(size: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import warp as wp

    from geokit.core.download import download_into

    monkeypatch.setattr(grid_array, "LARGEST_ARRAY", 5000)
    data = np.random.default_rng(size).integers(0, 256, size).astype(np.uint8)
    there = grid_array.copied_grid(grid_array.array_of(data), size, wp.get_device(device))
    copied = grid_array.copied_grid(there, size, there.device)
    assert there.shape == copied.shape == (min(size, 5000),)
    assert there.ptr != copied.ptr
    for array in (there, copied):
        back = np.empty_like(data)
        download_into(back, array)
        np.testing.assert_array_equal(back, data)
