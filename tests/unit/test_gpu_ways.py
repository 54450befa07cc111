"""What only a GPU does in its own way, done on the CPU: the same bytes."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit import _launch, _pinned
from geokit.volume import _band_sign, _device_build, _surface_nets, _tiles
from geokit.volume._tiles_kernels import last_kernel
from tests import catalogue


@pytest.fixture
def gpu_ways(monkeypatch):
    """Has the CPU do as a GPU does."""

    def change():
        monkeypatch.setattr(_pinned, "serves", lambda device: True)
        monkeypatch.setattr(_device_build, "PARTS_CPU", _device_build.PARTS_CUDA)
        monkeypatch.setattr(_band_sign, "ROUNDS_CPU", _band_sign.ROUNDS_CUDA)
        monkeypatch.setattr(_band_sign, "ROWS_CPU", _band_sign.ROWS_CUDA)
        monkeypatch.setattr(_tiles, "START_CELLS_CPU", _tiles.START_CELLS_CUDA)
        monkeypatch.setattr(_surface_nets, "_asks_for_problems", lambda device: True)

    return change


MESHES = {
    "box": catalogue.box(),
    "sphere": catalogue.icosphere(3),
    "edges": catalogue.l_profile(),
    "cavity": catalogue.nested_boxes(),
    "overlaps": catalogue.overlapping_spheres(),
    "holes": catalogue.holed_sphere(),
    "fins": catalogue.with_fins(catalogue.torus()),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
@pytest.mark.parametrize(
    "options", [{}, {"half_width": (2.0, 4.0)}, {"sign": "winding"}, {"sign": "parity"}, {"thickness": 0.3}]
)
def test_bands(mesh, options, gpu_ways):
    voxel = mesh.diagonal / 57.0
    expected = gk.volume.from_mesh(mesh, voxel, device="cpu", **options)
    gpu_ways()
    found = gk.volume.from_mesh(mesh, voxel, device="cpu", **options)
    np.testing.assert_array_equal(found.nanovdb, expected.nanovdb)


def test_integers(gpu_ways):
    mesh = catalogue.icosphere(3)
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
    _launch.launch(last_kernel, 1, [sums], [last], cpu)
    assert last.numpy()[0] == 9


@pytest.mark.parametrize("device", ["cpu", *_launch.cuda_devices()])
def test_sums(device):
    counts = wp.array([2, 0, 5, 1], dtype=wp.int32, device=device)
    sums, total = _tiles.counted(counts)
    np.testing.assert_array_equal(sums.numpy(), [2, 2, 7, 8])
    assert total == 8
    assert _tiles.counted(wp.zeros(0, dtype=wp.int32, device=device))[1] == 0
