"""CSG of level sets against minima and maxima of analytic distances."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._csg import difference, intersection, union
from tests.support.analytic_volumes import SHEARED, TURNED, active_voxels, ball, box, cubes, dense, field, level_set

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

A, B = ball(9.3, (-3.2, 0.4, 0.1)), box(6.2, (4.1, 0.3, -0.7))
OPERATIONS = {
    "union": (union, lambda a, b: np.minimum(a, b)),
    "intersection": (intersection, lambda a, b: np.maximum(a, b)),
    "difference": (difference, lambda a, b: np.maximum(a, -b)),
}
# Values and background are float32 below 16.
ROUNDING = 1e-6
# Trilinear interpolation of the distance from a sphere errs by up to h^2 / 8 of its curvature, 1 / r, in each of
# two axes; at the band's inner end r is 4 voxels.
RESAMPLED = 0.1


def smooth_minimum(a, b, width):
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - h * h * width / 4.0


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", OPERATIONS)
def test_values_are_extrema_of_the_distances(name, dtype):
    operation, combine = OPERATIONS[name]
    result = operation(level_set(A, dtype=dtype), level_set(B, dtype=dtype))
    points, values = active_voxels(result)
    assert len(points) > 1000
    assert result.info.grid_type == ("float" if dtype == np.float32 else "double")
    assert np.abs(values - combine(A(points), B(points))).max() < ROUNDING


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_voxel_has_its_side_and_a_band_of_the_same_width(name):
    operation, combine = OPERATIONS[name]
    result = operation(level_set(A), level_set(B))
    lower, upper = -20, 20
    steps = np.arange(lower, upper, dtype=float)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    true = combine(A(points), B(points))
    assert np.abs(dense(result, lower, upper).ravel() - np.clip(true, -3.0, 3.0)).max() < ROUNDING
    assert result.info.active_voxel_count == (np.abs(true) < 3.0).sum()
    assert (result.info.grid_class, result.info.background) == ("level set", 3.0)


def test_name_metadata_and_operands_are_kept():
    a, b = level_set(A, name="first"), level_set(B, name="second")
    before = a.nanovdb.copy(), b.nanovdb.copy()
    result = union(a, b)
    assert result.info.name == "first"
    assert result.info.metadata == {"author": "tests"}
    np.testing.assert_array_equal(a.nanovdb, before[0])
    np.testing.assert_array_equal(b.nanovdb, before[1])


@pytest.mark.slow
def test_several_operands():
    c = ball(4.2, (-12.0, 0.0, 0.0))
    points, values = active_voxels(union(level_set(A), level_set(B), level_set(c)))
    assert np.abs(values - np.minimum(np.minimum(A(points), B(points)), c(points))).max() < ROUNDING
    points, values = active_voxels(difference(level_set(A), level_set(B), level_set(c)))
    assert np.abs(values - np.maximum(np.maximum(A(points), -B(points)), -c(points))).max() < ROUNDING


@pytest.mark.slow
def test_disjoint_operands():
    a, b = ball(4.3, (-12.0, 0.0, 0.0)), ball(4.3, (12.0, 0.0, 0.0))
    assert intersection(level_set(a), level_set(b)).info.active_voxel_count == 0
    only = difference(level_set(a), level_set(b))
    np.testing.assert_array_equal(dense(only, -20, 20), dense(level_set(a), -20, 20))


@pytest.mark.parametrize("transform", [TURNED, cubes(0.13)], ids=["turned", "coarser"])
def test_second_operand_is_brought_to_the_first_one_s_grid(transform):
    center = tuple(transform[:3, 3] + 0.2)
    other = ball(0.9, center)
    fine = np.array(cubes(0.1))
    fine[:3, 3] = transform[:3, 3]
    mine = ball(0.8, tuple(transform[:3, 3] - 0.3))
    result = union(level_set(mine, transform=fine), level_set(other, transform=transform, half_width=3.0))
    points, values = active_voxels(result)
    np.testing.assert_array_equal(result.info.transform, fine)
    assert np.abs(values - np.minimum(mine(points), other(points))).max() < RESAMPLED * 0.13


@pytest.mark.slow
def test_other_band_and_type_of_the_second_operand():
    narrow, wide = level_set(B, half_width=2.0, dtype=np.float64), level_set(B, half_width=5.0)
    result = intersection(level_set(A), wide)
    points, values = active_voxels(result)
    assert result.info.background == 3.0
    assert np.abs(values - np.maximum(A(points), B(points))).max() < ROUNDING
    result = union(level_set(A), narrow)
    points, values = active_voxels(result)
    assert (result.info.grid_type, result.info.background) == ("float", 3.0)
    errors = np.abs(values - np.minimum(A(points), B(points)))
    # Voxels between the bands are computed: to a tenth of a voxel on faces, more where the box has edges.
    assert np.quantile(errors, 0.98) < 0.1
    assert errors[np.abs(values) < 1.9].max() < ROUNDING


class TestSmooth:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", OPERATIONS)
    def test_surface_is_that_of_the_smooth_minimum(self, name):
        operation, _ = OPERATIONS[name]
        a, b = ball(9.3, (-4.2, 0.4, 0.1)), ball(8.7, (6.1, 0.3, -0.7))
        width = 4.0
        smooth = {
            "union": lambda p: smooth_minimum(a(p), b(p), width),
            "intersection": lambda p: -smooth_minimum(-a(p), -b(p), width),
            "difference": lambda p: -smooth_minimum(-a(p), b(p), width),
        }[name]
        result = operation(level_set(a), level_set(b), smooth=width)
        points, values = active_voxels(result)
        near = np.abs(values) < 0.5
        # The blend's own slope falls to 0.7 in the seam, by which its values are divided.
        assert np.abs(smooth(points[near])).max() < 0.55
        signs = (values[near] < 0) == (smooth(points[near]) < 0)
        assert signs[np.abs(smooth(points[near])) > 0.02].all()
        assert result.info.background == 3.0

    @pytest.mark.slow
    def test_away_from_the_seam_nothing_changes(self):
        a, b = ball(9.3, (-4.2, 0.4, 0.1)), ball(8.7, (6.1, 0.3, -0.7))
        points, values = active_voxels(union(level_set(a), level_set(b), smooth=3.0))
        apart = np.abs(a(points) - b(points)) > 8.0
        assert apart.sum() > 1000
        assert np.abs(values - np.minimum(a(points), b(points)))[apart].max() < 0.05

    @pytest.mark.slow
    def test_slope_is_one(self):
        a, b = ball(9.3, (-4.2, 0.4, 0.1)), ball(8.7, (6.1, 0.3, -0.7))
        result = union(level_set(a), level_set(b), smooth=5.0)
        points, values = active_voxels(result)
        inner = np.abs(values) < 1.5
        slope = np.linalg.norm(np.asarray(result.gradient(points[inner], order=0, device="cpu")), axis=1)
        assert abs(np.sqrt(np.mean((slope - 1.0) ** 2))) < 0.02


class TestRefusals:
    @pytest.mark.parametrize("operation", [union, intersection, difference])
    def test_what_is_no_level_set(self, operation):
        good = level_set(A)
        with pytest.raises(InputError, match=r"b: ndarray is not a SparseVolume"):
            operation(good, np.zeros(3))
        with pytest.raises(InputError, match=r"a: grid 'field' is of class unknown"):
            operation(field(A, background=3.0), good)
        with pytest.raises(InputError, match=r"more\[0\]: the background of grid 'field' is 0"):
            operation(good, good, field(A, grid_class="level set"))
        with pytest.raises(UnsupportedGridError, match="type vec3f"):
            operation(good, field(lambda p: p, background=np.ones(3)))

    def test_voxels_that_are_no_cubes(self):
        with pytest.raises(InputError, match="b: the voxels of grid 'body' are not cubes"):
            union(level_set(A), level_set(A, transform=SHEARED))

    @pytest.mark.slow
    @pytest.mark.parametrize("smooth", [-0.1, np.nan, np.inf, "much", 300.0])
    def test_smooth(self, smooth):
        with pytest.raises(InputError, match="smooth"):
            union(level_set(A), level_set(B), smooth=smooth)
