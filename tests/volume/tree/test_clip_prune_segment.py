"""Pruning, clipping and connected components."""

from __future__ import annotations

import numpy as np
import pytest

from geokit import native
from geokit.errors import FileFormatError, InputError, UnsupportedGridError
from geokit.volume._components import segment
from geokit.volume._csg import difference, union
from geokit.volume._dense import from_dense
from geokit.volume._morphology import erode
from geokit.volume._topology import clip, prune
from geokit.volume.model.sparse_volume import SparseVolume
from tests.support.analytic_volumes import SHEARED, TURNED, active_voxels, ball, dense, field, level_set

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

BALL = ball(10.3, (0.3, 0.2, -0.1))
# How far a distance between two bodies may be off, in voxels.
NEAR = 0.05


def other_type(name):
    import dataclasses

    source = field(BALL)
    return SparseVolume(source.nanovdb, dataclasses.replace(source.info, grid_type=name))


class TestPrune:
    def test_constant_leaves_become_tiles(self):
        source = field(lambda p: np.where(p[:, 0] < 0, 2.0, p[:, 1]))
        result = prune(source)
        np.testing.assert_array_equal(dense(result, -18, 18), dense(source, -18, 18))
        assert result.info.active_voxel_count == source.info.active_voxel_count
        # Half of the 64 leaves, of 2 KiB each, are constant.
        assert len(result.nanovdb) < len(source.nanovdb) - 30 * 2048

    def test_tolerance(self):
        rng = np.random.default_rng(1)
        source = field(lambda p: 5.0 + rng.uniform(-0.1, 0.1, len(p)))
        assert len(prune(source).nanovdb) == pytest.approx(len(source.nanovdb), rel=0.01)
        result = prune(source, 0.25)
        assert len(result.nanovdb) < len(source.nanovdb) - 60 * 2048
        assert np.abs(dense(result, -16, 16) - dense(source, -16, 16)).max() <= 0.25

    def test_where_nothing_is_alike_the_volume_stays(self):
        source = field(BALL)
        assert prune(source) is source
        # A tile beside leaves is no leaf to prune.
        first = prune(field(lambda p: np.where((p >= 0).all(axis=1) & (p < 8).all(axis=1), 2.0, p[:, 1])))
        assert prune(first) is first

    def test_alike_in_a_sample_is_not_alike(self):
        values = np.full((8, 8, 8), 3.0, np.float32)
        values[0, 0, 1] = 4.0
        source = from_dense(values)
        assert prune(source) is source
        assert prune(source, 1.0).info.active_voxel_count == 512
        assert len(prune(source, 1.0).nanovdb) < len(source.nanovdb)

    @pytest.mark.parametrize("tolerance", [-1.0, np.nan, "some"])
    def test_refusals(self, tolerance):
        with pytest.raises(InputError, match="tolerance"):
            prune(field(BALL), tolerance)
        with pytest.raises(InputError, match="not a SparseVolume"):
            prune(None)


class TestClip:
    @pytest.mark.parametrize("transform", [None, TURNED], ids=["plain", "turned"])
    def test_voxels_whose_centers_are_inside(self, transform):
        source = field(lambda p: p[:, 0] + 2.0 * p[:, 1] + 100.0, transform=transform, background=-7.0)
        middle = np.zeros(3) if transform is None else transform[:3, 3]
        scale = 1.0 if transform is None else 0.1
        bounds = np.array([[-5.0, -7.3, -3.2], [4.0, 9.9, 6.1]]) * scale + middle
        result = clip(source, bounds)
        points, values = active_voxels(source)
        # Rounding decides on the box's faces, where voxel centers lie for one of the two.
        kept = ((points >= bounds[0] - 1e-9) & (points <= bounds[1] + 1e-9)).all(axis=1)
        found, clipped = active_voxels(result)
        assert len(found) == kept.sum() > 500
        np.testing.assert_array_equal(np.sort(clipped), np.sort(values[kept]))
        outside = np.asarray(result.sample(points[~kept], order=0, device="cpu"))
        assert (outside == -7.0).all()

    def test_tiles(self):
        source = prune(field(lambda p: np.full(len(p), 2.0)))
        result = clip(source, [[-3.5] * 3, [3.5] * 3])
        assert result.info.active_voxel_count == 7**3
        assert dense(result, -3, 4).min() == 2.0

    def test_everything_and_nothing(self):
        source = field(BALL)
        np.testing.assert_array_equal(dense(clip(source, [[-99] * 3, [99] * 3]), -16, 16), dense(source, -16, 16))
        assert clip(source, [[50] * 3, [60] * 3]).info.active_voxel_count == 0

    @pytest.mark.parametrize(
        "bounds",
        [np.zeros((3, 2)), [[0, 0, 0], [1, np.inf, 1]], [[0, 0, 2], [1, 1, 1]], "box", None, [[0, "a", 1], [1, 1, 1]]],
    )
    def test_refusals(self, bounds):
        with pytest.raises(InputError, match="bounds"):
            clip(field(BALL), bounds)
        with pytest.raises(InputError, match="not a SparseVolume"):
            clip(None, [[0] * 3, [1] * 3])


class TestSegment:
    def test_two_balls(self):
        large, small = ball(6.3, (-9.0, 0.0, 0.0)), ball(4.3, (10.0, 0.0, 0.0))
        components = segment(union(level_set(small), level_set(large)))
        assert len(components) == 2
        for component, distance in zip(components, (large, small), strict=True):
            points, values = active_voxels(component)
            assert np.abs(values - distance(points)).max() < 1e-5
            assert (component.info.grid_class, component.info.background, component.info.name) == (
                "level set",
                3.0,
                "body",
            )
            assert component.info.metadata == {"author": "tests"}
        assert components[0].info.active_voxel_count > components[1].info.active_voxel_count

    def test_balls_whose_bands_touch_are_two(self):
        a, b = ball(6.3, (-8.0, 0.0, 0.0)), ball(6.3, (8.0, 0.0, 0.0))
        assert len(segment(union(level_set(a), level_set(b)))) == 2

    @pytest.mark.parametrize("cavity", [7.3, 4.3])
    def test_hollow_body_is_one(self, cavity):
        shell = difference(level_set(ball(12.3)), level_set(ball(cavity)))
        components = segment(shell)
        assert len(components) == 1
        np.testing.assert_array_equal(dense(components[0], -18, 18), dense(shell, -18, 18))
        assert components[0].info.background == 3.0

    @pytest.mark.slow
    def test_body_in_the_cavity_of_another(self):
        shell = difference(level_set(ball(15.3)), level_set(ball(10.3)))
        components = segment(union(level_set(ball(4.3)), shell))
        assert len(components) == 2
        # Their bands meet: to a tenth of a voxel a distance may be either's.
        np.testing.assert_allclose(dense(components[0], -20, 20), dense(shell, -20, 20), atol=NEAR)
        np.testing.assert_allclose(dense(components[1], -20, 20), dense(level_set(ball(4.3)), -20, 20), atol=NEAR)

    @pytest.mark.slow
    @pytest.mark.parametrize("gap", [0.8, 1.8, 3.1])
    def test_between_bodies_that_nearly_touch(self, gap):
        x = 6.3 + gap / 2.0
        a, b = ball(6.3, (-x, 0.0, 0.0)), ball(6.3, (x, 0.0, 0.0))
        components = segment(union(level_set(a), level_set(b)))
        # Equally large: their order is open.
        components.sort(key=lambda component: component.info.index_bounds[0, 0])
        for component, own in zip(components, (a, b), strict=True):
            np.testing.assert_allclose(dense(component, -18, 18), dense(level_set(own), -18, 18), atol=NEAR)

    def test_active_voxels_of_fields(self):
        source = field(lambda p: p[:, 0])
        left, right = clip(source, [[-15, -3, -3], [-9, 3, 3]]), clip(source, [[2, -2, -2], [6, 2, 2]])
        both = SparseVolume(native.operations.csg(left.nanovdb, right.nanovdb, "union"), left.info)
        components = segment(both) if both.info.grid_class != "level set" else []
        assert [component.info.active_voxel_count for component in components] == [7**3, 5**3]

    @pytest.mark.filterwarnings("ignore:.*nothing of grid:UserWarning")
    def test_nothing(self):
        assert segment(erode(level_set(ball(5.3)), 8.0)) == []

    def test_refusals(self):
        with pytest.raises(InputError, match="not a SparseVolume"):
            segment("a.vdb")
        with pytest.raises(InputError, match="not cubes"):
            segment(level_set(ball(1.0), transform=SHEARED))


@pytest.mark.parametrize("operation", [prune, lambda v: clip(v, [[0] * 3, [1] * 3]), segment])
def test_buffers_that_are_not_of_their_type(operation):
    buffer = field(BALL).nanovdb.copy()
    buffer[636:640] = np.array([25, 0, 0, 0], np.uint8)  # NanoVDB's vec3u16, whose leaves are larger
    source = SparseVolume(buffer, other_type("vec3u16").info)
    with pytest.raises(FileFormatError, match="damaged"):
        operation(source)


@pytest.mark.parametrize("operation", [prune, lambda v: clip(v, [[0] * 3, [1] * 3]), segment])
def test_grids_without_values_are_refused_by_name(operation):
    with pytest.raises(UnsupportedGridError, match="type onindex"):
        operation(other_type("onindex"))
