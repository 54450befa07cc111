"""Offsets, morphology and renormalisation against analytic distances."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog.mesh_catalog import torus
from geokit import native
from geokit.errors import InputError, UnsupportedGridError
from geokit.mesh._audit import audit
from geokit.volume._morphology import closing, dilate, erode, offset, opening, renormalize
from geokit.volume.distance_fields.from_mesh import from_mesh
from geokit.volume.level_set.operands import with_band
from tests.support.analytic_volumes import SHEARED, TURNED, active_voxels, ball, box, dense, field, level_set
from tests.support.effort import of_all
from tests.support.lying_grids import lying

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

BALL = ball(10.3, (0.3, 0.2, -0.1))
# What the docstrings promise, in voxels.
SURFACE_MOTION, OFFSET_ERROR, DISTANCE_ERROR = 0.005, 0.05, 0.005


def crossings(values, other):
    """Motion of the zero along its normal, between fields on the same voxels: one for each edge that it crosses."""
    slope = np.stack(np.gradient(values), axis=-1)
    slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)
    moved = []
    for axis in range(3):
        first, second = ([slice(None)] * 3 for _ in range(2))
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        a, b, c, d = values[tuple(first)], values[tuple(second)], other[tuple(first)], other[tuple(second)]
        crossed = (a < 0) != (b < 0)
        # A crossing that has gone elsewhere has moved by a voxel at least.
        stays = ((c < 0) != (d < 0))[crossed]
        before = (a / np.where(a == b, 1.0, a - b))[crossed]
        after = (c / np.where(c == d, 1.0, c - d))[crossed]
        along = np.abs(slope[tuple(first)][crossed][:, axis])
        moved.append(np.where(stays, np.abs(after - before) * along, 1.0))
    return np.concatenate(moved)


class TestRenormalize:
    @pytest.mark.slow
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("factor", of_all([0.3, 1e4, 1e-4], [1.0, 2.0, 0.3, 1e4, 1e-4]))
    def test_scaled_distances_become_distances_and_the_surface_stays(self, factor, dtype):
        before = level_set(BALL, values=lambda p: factor * BALL(p), half_width=4.0, dtype=dtype)
        after = renormalize(before)
        points, values = active_voxels(after)
        assert np.abs(values - BALL(points)).max() < DISTANCE_ERROR
        moved = crossings(dense(before, -16, 16), dense(after, -16, 16))
        assert len(moved) > 1000
        assert moved.max() < 1e-4
        assert after.info.background == 4.0

    @pytest.mark.parametrize("radius", [10.3, 18.2])
    def test_slope_that_changes_by_four_percent_a_voxel(self, radius):
        distance = ball(radius, (0.3, 0.2, -0.1))
        before = level_set(
            distance, values=lambda p: distance(p) * (1.0 + 0.28 * np.sin(0.1 * p[:, 0])), half_width=4.0
        )
        after = renormalize(before)
        moved = crossings(dense(before, -24, 24), dense(after, -24, 24))
        assert moved.max() < SURFACE_MOTION
        points, values = active_voxels(after)
        assert np.abs(values - distance(points)).max() < 0.1

    def test_slope_is_one_in_the_band(self):
        after = renormalize(level_set(BALL, values=lambda p: 1.7 * BALL(p)))
        points, values = active_voxels(after)
        inner = np.abs(values) < 1.5
        slope = np.linalg.norm(np.asarray(after.gradient(points[inner], order=0, device="cpu")), axis=1)
        assert np.abs(slope - 1.0).max() < 0.02

    def test_distances_next_to_the_surface_keep_their_bits(self):
        before = level_set(BALL)
        first, second = dense(before, -16, 16), dense(renormalize(before), -16, 16)
        near = np.abs(first) < 0.3
        assert near.sum() > 500
        np.testing.assert_array_equal(first[near], second[near])

    @pytest.mark.parametrize("scale", [1.0, 1.5])
    def test_sharp_edges_stay(self, scale):
        distance = box(10.3)
        before = level_set(distance, values=lambda p: scale * distance(p))
        after = renormalize(before)
        assert crossings(dense(before, -16, 16), dense(after, -16, 16)).max() < 1e-4
        points, values = active_voxels(after)
        assert np.abs(values - distance(points)).max() < 0.3

    @pytest.mark.parametrize("half_width", [1.0, 2.0, 6.0])
    def test_other_band(self, half_width):
        after = renormalize(level_set(BALL), half_width=half_width)
        points, values = active_voxels(after)
        assert after.info.background == half_width
        assert np.abs(values).max() < half_width
        assert np.abs(values - BALL(points)).max() < 0.05
        steps = np.arange(-20, 20, dtype=float)
        everywhere = BALL(np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3))
        # Which side of the band's end a voxel lies on is as certain as its distance.
        assert np.sum(np.abs(everywhere) < half_width - 0.05) <= len(points)
        assert len(points) <= np.sum(np.abs(everywhere) < half_width + 0.05)

    @pytest.mark.parametrize("half_width", [1.0, 1.5, 2.0, 3.0])
    def test_wider_band_keeps_what_is_known(self, half_width):
        body = level_set(BALL, half_width=half_width)
        wide = with_band(body, 1.0, 8.0, device="cpu")
        before, after = dense(body, -22, 22), dense(wide, -22, 22)
        known = np.abs(before) < half_width
        np.testing.assert_array_equal(before[known], after[known])
        steps = np.arange(-22, 22, dtype=float)
        points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        assert np.abs(after.ravel() - np.clip(BALL(points), -8.0, 8.0)).max() < OFFSET_ERROR

    def test_threads_do_not_change_a_bit(self, monkeypatch):
        body = level_set(BALL, values=lambda p: BALL(p) * (1.0 + 0.2 * np.sin(0.1 * p[:, 0])))
        one, two = [], []
        for threads, results in (("1", one), ("2", two)):
            monkeypatch.setenv("GEOKIT_THREADS", threads)
            results.append(renormalize(body, half_width=6.0, device="cpu").nanovdb)
        np.testing.assert_array_equal(one[0], two[0])


class TestOffset:
    @pytest.mark.slow
    @pytest.mark.parametrize("distance", of_all([0.4, 5.0, -1.0, -5.0], [0.4, 1.0, 2.5, 5.0, -0.4, -1.0, -2.5, -5.0]))
    def test_surface_moves_by_the_distance(self, distance):
        result = offset(level_set(BALL), distance)
        points, values = active_voxels(result)
        assert np.abs(values - (BALL(points) - distance)).max() < OFFSET_ERROR
        assert result.info.background == 3.0

    def test_turned_voxels_and_world_units(self):
        distance = ball(1.03, tuple(TURNED[:3, 3]))
        result = offset(level_set(distance, transform=TURNED), 0.17)
        points, values = active_voxels(result)
        assert np.abs(values - (distance(points) - 0.17)).max() < OFFSET_ERROR * 0.1
        np.testing.assert_array_equal(result.info.transform, TURNED)

    def test_zero_is_renormalisation(self):
        body = level_set(BALL)
        np.testing.assert_array_equal(offset(body, 0.0).nanovdb, renormalize(body).nanovdb)

    def test_box_grows_faces_and_rounded_edges(self):
        result = offset(level_set(box(8.3)), 2.0)
        points, values = active_voxels(result)
        true = box(8.3)(points) - 2.0
        # The grown box is rounded: outside it the distance is that of the box less the offset, also beyond its edges.
        assert np.abs(values - true)[true > 0].max() < 0.25

    @pytest.mark.slow
    def test_inside_signs(self):
        values = dense(offset(level_set(BALL), 2.0), -16, 16)
        steps = np.arange(-16, 16, dtype=float)
        true = BALL(np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)) - 2.0
        clear = np.abs(true) > OFFSET_ERROR
        np.testing.assert_array_equal(values.ravel()[clear] < 0, true[clear] < 0)


class TestMorphology:
    @pytest.mark.slow
    def test_dilate_and_erode_are_offsets(self):
        body = level_set(BALL)
        np.testing.assert_array_equal(dilate(body, 1.5).nanovdb, offset(body, 1.5).nanovdb)
        np.testing.assert_array_equal(erode(body, 1.5).nanovdb, offset(body, -1.5).nanovdb)

    @pytest.mark.filterwarnings("ignore:.*nothing of grid:UserWarning")
    def test_erosion_of_everything_in_a_band_without_end(self):
        # The width is that of the background, which a damaged file may have made the largest of all.
        body = lying(from_mesh(torus(), 0.25, device="cpu"), "background 3.4e38")
        assert erode(body, 0.5, device="cpu").info.active_voxel_count == 0

    @pytest.mark.filterwarnings("ignore:.*nothing of grid:UserWarning")
    def test_erosion_of_everything(self):
        result = erode(level_set(ball(5.2)), 7.0)
        assert result.info.active_voxel_count == 0
        assert (dense(result, -8, 8) == 3.0).all()

    @pytest.mark.slow
    def test_opening_takes_thin_parts(self):
        rod = lambda p: np.maximum(np.abs(p[:, 0]) - 18.0, np.hypot(p[:, 1], p[:, 2]) - 1.6)  # noqa: E731
        both = lambda p: np.minimum(BALL(p), rod(p))  # noqa: E731
        points, values = active_voxels(opening(level_set(both), 2.5))
        assert np.abs(points[:, 0]).max() < 15.0
        away = np.hypot(points[:, 1], points[:, 2]) > 6.0
        assert np.abs(values - BALL(points))[away].max() < 2 * OFFSET_ERROR

    @pytest.mark.slow
    def test_closing_fills_a_gap(self):
        halves = lambda p: np.maximum(box(9.3)(p), 1.2 - np.abs(p[:, 0]))  # noqa: E731
        result = closing(level_set(halves), 2.0)
        inside = np.array([[0.0, 0.0, 0.0], [0.3, 5.0, 5.0], [12.0, 0.0, 0.0]])
        np.testing.assert_array_equal(np.asarray(result.sample(inside, device="cpu")) < 0, [True, True, False])

    @pytest.mark.slow
    def test_ball_is_open_and_closed(self):
        for operation in (opening, closing):
            points, values = active_voxels(operation(level_set(BALL), 2.0))
            assert np.abs(values - BALL(points)).max() < 2 * OFFSET_ERROR


class TestRefusals:
    @pytest.mark.parametrize("operation", [renormalize, *(lambda v, f=f: f(v, 1.0) for f in (offset, dilate, closing))])
    def test_what_is_no_level_set(self, operation):
        with pytest.raises(InputError, match="not a SparseVolume"):
            operation("body.vdb")
        with pytest.raises(InputError, match="of class unknown"):
            operation(field(BALL))
        with pytest.raises(UnsupportedGridError, match="type vec3f"):
            operation(field(lambda p: p, background=np.zeros(3)))
        with pytest.raises(InputError, match="not cubes"):
            operation(level_set(BALL, transform=SHEARED))

    @pytest.mark.parametrize("half_width", [0.5, 1000.0, np.nan, "wide"])
    def test_half_width(self, half_width):
        with pytest.raises(InputError, match="half_width"):
            renormalize(level_set(BALL), half_width=half_width)

    @pytest.mark.parametrize("distance", [np.nan, np.inf, "far", 1000.0])
    def test_distance(self, distance):
        with pytest.raises(InputError, match="distance"):
            offset(level_set(BALL), distance)

    @pytest.mark.parametrize("operation", [dilate, erode, opening, closing])
    def test_negative_distance(self, operation):
        with pytest.raises(InputError, match=r"distance: -1\.0 is negative"):
            operation(level_set(BALL), -1.0)


@pytest.mark.parametrize("shrink", [lambda v: offset(v, -0.6), lambda v: erode(v, 0.6), lambda v: opening(v, 0.6)])
def test_a_body_that_vanishes_is_told(shrink):
    body = from_mesh(gk.mesh.box(), 0.1, device="cpu")
    with pytest.warns(UserWarning, match=r"nothing of grid 'box' is left: it has no place 0\.6 deep"):
        assert shrink(body).info.active_voxel_count == 0


@pytest.mark.parametrize(
    ("bodies", "distance", "count"),
    [
        ([((0.019, 0.205, -0.008), 0.493, None), ((0.287, 0.399, 0.497), None, 0.462)], -0.25, 2),
        ([((-0.243, -0.297, -0.106), None, 0.5), ((-0.064, -0.738, 0.543), None, 0.7)], -0.12, 1),
        ([((-0.052, 0.069, 0.116), 0.693, None), ((-0.092, 0.35, -0.128), None, 0.608)], 0.35, 1),
    ],
)
def test_an_offset_of_a_union_leaves_no_crumbs(bodies, distance, count):
    """Voxels beyond the band, where two bodies meet, got distances of 0: holes and bodies of one voxel."""
    parts = [
        gk.mesh.box((2 * half,) * 3, center=center)
        if half
        else gk.mesh.sphere(radius=radius, center=center, segments=48)
        for center, half, radius in bodies
    ]
    joined = gk.volume.union(*(from_mesh(part, 0.1, device="cpu") for part in parts))
    made = offset(joined, distance)
    assert audit(gk.mesh.from_volume(made, device="cpu")).component_count == count
