"""Differential operators against derivatives of polynomials, under every affine transform."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._differential import curl, divergence, gradient_field, laplacian
from tests.support.analytic_volumes import SHEARED, TURNED, active_voxels, cubes, field

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

TRANSFORMS = [cubes(1.0), TURNED, SHEARED, np.diag([-0.2, 0.3, 0.5, 1.0])]
IDS = ["unit", "turned", "sheared", "mirrored"]
A = np.array([[0.3, -0.2, 0.5], [0.1, 0.7, -0.4], [0.6, 0.2, -0.9]])
# Rounding of float64 values below 1e3, divided by a step of 0.1 (and by its square).
FIRST, SECOND = 1e-11, 1e-9


def inner(volume, points, margin=1.0):
    """Active voxels at least ``margin`` voxels from the border of the cube that ``field`` makes."""
    matrix = volume.info.transform
    index = (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    return (np.abs(index + 0.5) < 16.0 - margin).all(axis=1)


def quadratic(points):
    return np.einsum("ni,ij,nj->n", points, A, points) + points @ np.array([1.0, -2.0, 0.5])


def linear_vectors(points):
    return points @ A.T + np.array([0.5, -1.0, 2.0])


@pytest.mark.parametrize("transform", TRANSFORMS, ids=IDS)
class TestExact:
    def test_gradient_of_a_quadratic(self, transform):
        source = field(quadratic, transform=transform, dtype=np.float64)
        result = gradient_field(source, device="cpu")
        points, values = active_voxels(result)
        kept = inner(source, points)
        true = points @ (A + A.T) + np.array([1.0, -2.0, 0.5])
        assert np.abs(values - true)[kept].max() < FIRST * 100
        assert result.info.grid_type == "vec3d"
        assert result.info.active_voxel_count == source.info.active_voxel_count
        np.testing.assert_array_equal(result.info.transform, transform)

    def test_laplacian_of_a_quadratic(self, transform):
        source = field(quadratic, transform=transform, dtype=np.float64)
        points, values = active_voxels(laplacian(source, device="cpu"))
        assert np.abs(values - 2.0 * np.trace(A))[inner(source, points)].max() < SECOND * 100

    def test_divergence_and_curl_of_linear_vectors(self, transform):
        source = field(linear_vectors, transform=transform, dtype=np.float64, background=np.zeros(3))
        points, values = active_voxels(divergence(source, device="cpu"))
        kept = inner(source, points)
        assert np.abs(values - np.trace(A))[kept].max() < FIRST
        points, values = active_voxels(curl(source, device="cpu"))
        true = np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])
        assert np.abs(values - true)[kept].max() < FIRST

    @pytest.mark.slow
    def test_curl_of_a_gradient_and_divergence_of_a_curl_vanish(self, transform):
        wave = lambda p: np.sin(1.3 * p[:, 0]) * np.cos(0.7 * p[:, 1] + p[:, 2])  # noqa: E731
        source = field(wave, transform=transform, dtype=np.float64)
        points, values = active_voxels(curl(gradient_field(source, device="cpu"), device="cpu"))
        assert np.abs(values)[inner(source, points, 2.0)].max() < SECOND
        flow = lambda p: np.stack([np.sin(p[:, 1]), p[:, 0] * p[:, 2], np.cos(p[:, 0] - p[:, 1])], axis=1)  # noqa: E731
        source = field(flow, transform=transform, dtype=np.float64, background=np.zeros(3))
        points, values = active_voxels(divergence(curl(source, device="cpu"), device="cpu"))
        assert np.abs(values)[inner(source, points, 2.0)].max() < SECOND


def test_second_order():
    errors = []
    for size in (0.2, 0.1):
        source = field(lambda p: np.sin(2.0 * p[:, 0]), transform=cubes(size), dtype=np.float64)
        points, values = active_voxels(gradient_field(source, device="cpu"))
        kept = inner(source, points)
        errors.append(np.abs(values[:, 0] - 2.0 * np.cos(2.0 * points[:, 0]))[kept].max())
    assert 3.8 < errors[0] / errors[1] < 4.2


def test_float_gives_float():
    assert gradient_field(field(quadratic), device="cpu").info.grid_type == "vec3f"
    assert laplacian(field(quadratic), device="cpu").info.grid_type == "float"
    vectors = field(linear_vectors, background=np.zeros(3))
    assert divergence(vectors, device="cpu").info.grid_type == "float"
    assert curl(vectors, device="cpu").info.grid_type == "vec3f"


def test_active_tiles_become_voxels():
    from geokit.volume._topology import prune

    source = field(lambda p: np.full(len(p), 2.0))
    tiles = prune(source)
    assert len(tiles.nanovdb) < len(source.nanovdb)
    points, values = active_voxels(gradient_field(tiles, device="cpu"))
    expected, others = active_voxels(gradient_field(source, device="cpu"))
    np.testing.assert_array_equal(points, expected)
    np.testing.assert_array_equal(values, others)


class TestStaggered:
    def test_divergence_of_faces(self):
        # Component c of voxel i is at the lower face along c: half a voxel before the center.
        size = 0.1
        faces = lambda p: np.stack([(p[:, c] - size / 2) ** 2 for c in range(3)], axis=1)  # noqa: E731
        source = field(faces, transform=cubes(size), dtype=np.float64, background=np.zeros(3), grid_class="staggered")
        points, values = active_voxels(divergence(source, device="cpu"))
        assert np.abs(values - 2.0 * points.sum(axis=1))[inner(source, points)].max() < FIRST

    def test_what_staggered_grids_cannot(self):
        staggered = field(linear_vectors, background=np.zeros(3), grid_class="staggered")
        with pytest.raises(InputError, match="staggered"):
            curl(staggered)
        turned = field(linear_vectors, background=np.zeros(3), grid_class="staggered", transform=TURNED)
        with pytest.raises(InputError, match="not along the world's axes"):
            divergence(turned)


class TestRefusals:
    @pytest.mark.parametrize("operation", [gradient_field, laplacian])
    def test_scalars(self, operation):
        with pytest.raises(InputError, match="not a SparseVolume"):
            operation(None)
        with pytest.raises(UnsupportedGridError, match="takes float, double"):
            operation(field(linear_vectors, background=np.zeros(3)))

    @pytest.mark.parametrize("operation", [divergence, curl])
    def test_vectors(self, operation):
        with pytest.raises(InputError, match="not a SparseVolume"):
            operation(None)
        with pytest.raises(UnsupportedGridError, match="takes vec3f, vec3d"):
            operation(field(quadratic))

    def test_tiles_beyond_memory(self, monkeypatch):
        from geokit.core.memory import available_memory
        from geokit.errors import DeviceMemoryError
        from geokit.volume._dense import from_dense
        from geokit.volume._topology import prune
        from geokit.volume.tree import estimates

        tiles = prune(from_dense(np.full((64, 64, 64), 2.0), voxel_size=1.0))
        monkeypatch.setattr(estimates, "UNCHECKED_BYTES", 0)
        monkeypatch.setattr(available_memory, "available_host", lambda: 2 * tiles.info.byte_count)
        with pytest.raises(DeviceMemoryError, match="active tiles"):
            gradient_field(tiles)
