"""What only a GPU does in its own way, done on the CPU: the same bytes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.core.memory import pinned
from geokit.core.scan_kernels import last_kernel
from geokit.volume.band import signs, tiles
from geokit.volume.isosurface import surface_nets
from geokit.volume.tree import device_writer
from tests.support.devices import DEVICES
from tests.support.effort import of_all


@pytest.fixture
def gpu_ways(monkeypatch):
    """Has the CPU do as a GPU does."""

    def change():
        monkeypatch.setattr(pinned, "uses_pinned_memory", lambda device: True)
        monkeypatch.setattr(device_writer, "PARTS_CPU", device_writer.PARTS_CUDA)
        monkeypatch.setattr(signs, "ROUNDS_CPU", signs.ROUNDS_CUDA)
        monkeypatch.setattr(signs, "ROWS_CPU", signs.ROWS_CUDA)
        monkeypatch.setattr(tiles, "START_CELLS_CPU", tiles.START_CELLS_CUDA)
        monkeypatch.setattr(surface_nets, "_searches_without_flag", lambda device: True)

    return change


MESHES = {
    "box": mesh_catalog.box(),
    "sphere": mesh_catalog.icosphere(3),
    "edges": mesh_catalog.l_profile(),
    "cavity": mesh_catalog.nested_boxes(),
    "overlaps": mesh_catalog.overlapping_spheres(),
    "holes": mesh_catalog.holed_sphere(),
    "fins": mesh_catalog.with_fins(mesh_catalog.torus()),
}


OPTIONS = [{}, {"half_width": (2.0, 4.0)}, {"sign": "winding"}, {"sign": "parity"}, {"thickness": 0.3}]
# Each mesh with its own sign and with one of the others.
SOME = [(name, number) for k, name in enumerate(MESHES) for number in (0, 1 + k % 4)]
CASES = of_all(SOME, [*product(MESHES, range(len(OPTIONS)))])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "options"),
    [pytest.param(MESHES[name], OPTIONS[number], id=f"{name}-{number}") for name, number in CASES],
)
def test_bands(mesh, options, gpu_ways):
    voxel = mesh.diagonal / 57.0
    expected = gk.volume.from_mesh(mesh, voxel, device="cpu", **options)
    gpu_ways()
    found = gk.volume.from_mesh(mesh, voxel, device="cpu", **options)
    np.testing.assert_array_equal(found.nanovdb, expected.nanovdb)


def test_integers(gpu_ways):
    mesh = mesh_catalog.icosphere(3)
    expected = gk.volume.from_mesh_with_triangles(mesh, 0.1, device="cpu").triangle_id.nanovdb
    gpu_ways()
    np.testing.assert_array_equal(
        gk.volume.from_mesh_with_triangles(mesh, 0.1, device="cpu").triangle_id.nanovdb, expected
    )


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_surfaces(noise, gpu_ways):
    rng = np.random.default_rng(3)
    x, y, z = np.meshgrid(*3 * [np.arange(24.0)], indexing="ij")
    values = np.sqrt((x - 12.3) ** 2 + (y - 11.8) ** 2 + (z - 12.1) ** 2) - 8.0 + noise * rng.normal(size=x.shape)
    volume = gk.volume.from_dense(values.astype(np.float32), voxel_size=1.0, background=5.0)
    expected = gk.mesh.from_volume(volume, device="cpu")
    gpu_ways()
    found = gk.mesh.from_volume(volume, device="cpu")
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)


def test_the_last_sum():
    cpu = wp.get_device("cpu")
    sums, last = wp.array([1, 4, 9], dtype=wp.int32, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
    launcher.launch(last_kernel, 1, [sums], [last], cpu)
    assert last.numpy()[0] == 9


@pytest.mark.parametrize("device", DEVICES)
def test_sums(device):
    counts = wp.array([2, 0, 5, 1], dtype=wp.int32, device=device)
    sums, total = tiles.prefix_sum(counts)
    np.testing.assert_array_equal(sums.numpy(), [2, 2, 7, 8])
    assert total == 8
    assert tiles.prefix_sum(wp.zeros(0, dtype=wp.int32, device=device))[1] == 0
