"""Bands of two widths stay what they are in every operation of level sets, against the distance of a box's face."""

from __future__ import annotations

import functools
from itertools import product

import numpy as np
import pytest

import geokit as gk
from geokit.errors import InputError
from geokit.volume.level_set.band_widths import BandWidths, widths_of, with_widths
from geokit.volume.level_set.operands import with_band
from geokit.volume.tree.leaves import dequantized
from tests.support.analytic_volumes import active_voxels
from tests.support.effort import of_all, spread

SIZE = 0.1
PAIRS = of_all([(1.5, 6.0), (5.5, 2.0)], [(1.5, 6.0), (6.0, 1.5), (3.0, 8.0), (5.5, 2.0), (1.0, 4.0), (4.0, 1.2)])
MOVED = np.array([[SIZE, 0, 0, 0.033], [0, SIZE, 0, 0.02], [0, 0, SIZE, -0.05], [0, 0, 0, 1.0]])
OPERATIONS = {
    "resample, moved": lambda v: gk.volume.resample(v, transform=MOVED),
    "resample, coarser": lambda v: gk.volume.resample(v, voxel_size=2 * SIZE),
    "resample, finer": lambda v: gk.volume.resample(v, voxel_size=SIZE / 2),
    "smooth": lambda v: gk.volume.smooth(v, "median"),
    "renormalize": gk.volume.renormalize,
    "offset out": lambda v: gk.volume.offset(v, 0.04),
    "offset in, beyond the band": lambda v: gk.volume.offset(v, -0.7),
    "opening": lambda v: gk.volume.opening(v, 0.12),
    "closing": lambda v: gk.volume.closing(v, 0.12),
    "union": lambda v: gk.volume.union(v, far_ball()),
    "difference": lambda v: gk.volume.difference(v, far_ball()),
    "intersection": lambda v: gk.volume.intersection(v, cube(3.0, 4.0)),
    "smooth union": lambda v: gk.volume.union(v, far_ball(), smooth=0.2),
    "prune": gk.volume.prune,
    "clip": lambda v: gk.volume.clip(v, [[-9, -9, -9], [9, 9, 9]]),
    "quantize": lambda v: gk.volume.quantize(v, "fp16"),
}
# Where the face of the box is after the operation [world].
MOTION = {"offset out": 0.04, "offset in, beyond the band": -0.7}


@functools.cache
def cube(half_width, half=2.0, **options):
    return gk.volume.from_mesh(gk.mesh.box(3 * [2 * half]), SIZE, half_width=half_width, **options)


@functools.cache
def far_ball():
    ball = gk.mesh.sphere(0.5, center=(5.0, 0.0, 0.0))
    return gk.volume.from_mesh(ball, SIZE, half_width=3.0)


def ball_field():
    """Distances to a ball of radius 8 that nobody has cut off, shape (24, 24, 24)."""
    points = np.stack(np.meshgrid(*3 * [np.arange(-12.0, 12.0)], indexing="ij"), axis=-1)
    return np.linalg.norm(points, axis=-1) - 8.0


@pytest.fixture(params=PAIRS, ids=str)
def pair(request):
    return request.param


@pytest.fixture
def band(pair):
    return cube(pair)


class TestWidths:
    def test_a_band_says_its_widths(self, band, pair):
        assert widths_of(band, SIZE) == pytest.approx(pair)

    @pytest.mark.parametrize("codec", ["fp16", "fp8", "fpn"])
    def test_of_quantized_values_too(self, band, pair, codec):
        assert widths_of(
            gk.volume.quantize(band, codec, tolerance=1e-5 if codec == "fpn" else None), SIZE
        ) == pytest.approx(pair, rel=1e-3)

    def test_of_one_width(self):
        assert widths_of(cube(3.0), SIZE) == (3.0, 3.0)

    def test_a_body_without_inactive_inside_keeps_all_that_it_holds(self):
        thin = cube((1.5, 9.0), half=0.5)
        deepest = -active_voxels(thin)[1].min() / SIZE
        assert widths_of(thin, SIZE) == pytest.approx((1.5, deepest))
        finer = gk.volume.resample(thin, transform=MOVED)
        points, values = active_voxels(finer)
        near = np.abs(points).max(axis=1) < 0.45
        exact = np.abs(points[near]).max(axis=1) - 0.5
        # Trilinear, so rounded at the middle planes.
        assert np.abs(values[near] - exact).max() < 0.9 * SIZE
        assert values.min() < -0.35

    def test_fields_that_do_not_say_count_as_of_one_width(self):
        field = ball_field()
        # Inside, inactive voxels hold different values.
        lower = np.where(np.arange(len(field)) > len(field) // 2, -3.0, -4.0)[:, None, None]
        values = np.where(np.abs(field) < 3.0, field, np.where(field > 0, 3.0, lower))
        volume = gk.volume.from_dense(values, voxel_size=1.0, background=3.0, grid_class="level set")
        assert widths_of(volume, 1.0) == (3.0, 3.0)

    @pytest.mark.parametrize("kind", ["float32", "float64"])
    def test_a_field_that_is_active_everywhere_is_no_band(self, kind):
        field = ball_field().astype(kind)
        # No value is the background, so none is inactive.
        volume = gk.volume.from_dense(field, voxel_size=1.0, background=2.5, grid_class="level set")
        assert volume.info.active_voxel_count == field.size
        assert widths_of(volume, 1.0) == (2.5, 2.5)
        _, values = active_voxels(gk.volume.offset(volume, 0.5))
        assert values.min() >= -2.5
        assert values.max() <= 2.5

    def test_values_that_a_file_has_rounded_do_not_exceed_the_background(self):
        field = np.clip(ball_field(), -6.0, 2.5)
        rounded = np.where((field > 2.4) & (field < 2.5), 2.5 * (1.0 + 2.0**-11), field)
        assert (rounded > 2.5).any()
        volume = gk.volume.from_dense(rounded, voxel_size=1.0, background=2.5, grid_class="level set")
        assert widths_of(volume, 1.0) == (2.5, 6.0)

    def test_the_narrowed_band_is_that_of_the_mesh(self, pair):
        """Cut from a wider band, the leaves, active voxels and values are those that from_mesh makes."""
        made, cut = cube(pair), with_widths(cube(max(pair)), SIZE, BandWidths(*pair))
        places, values = active_voxels(made)
        other_places, other_values = active_voxels(cut)
        order, other = np.lexsort(places.T), np.lexsort(other_places.T)
        assert (places[order] == other_places[other]).all()
        assert (values[order] == other_values[other]).all()
        points = np.random.default_rng(0).uniform(-3.5, 3.5, (4000, 3))
        assert (made.sample(points, order=0) == cut.sample(points, order=0)).all()

    def test_holes_of_open_meshes_keep_their_sign_change(self):
        box = gk.mesh.box(3 * [4.0])
        top = box.vertices[box.faces][:, :, 2].min(axis=1) > 1.9
        bowl = gk.mesh.TriangleMesh(box.vertices, box.faces[~top])
        made = gk.volume.from_mesh(bowl, SIZE, half_width=(2.0, 5.0), sign="winding")
        cut = with_widths(gk.volume.from_mesh(bowl, SIZE, half_width=5.0, sign="winding"), SIZE, BandWidths(2.0, 5.0))
        points = np.random.default_rng(1).uniform(-3.0, 3.0, (20000, 3))
        ours, right = cut.sample(points, order=0), made.sample(points, order=0)
        assert (np.sign(ours) == np.sign(right)).all()


class TestOperations:
    # By default each with one of the pairs.
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "pair"),
        of_all([(name, PAIRS[k % 2]) for k, name in enumerate(spread(OPERATIONS, 8))], [*product(OPERATIONS, PAIRS)]),
    )
    def test_both_widths_stay_and_distances_are_right_in_both(self, band, pair, name):
        result = OPERATIONS[name](band)
        size = float(result.info.voxel_size[0])
        outside, inside = pair
        deep, far = result.sample([[0.0, 0.0, 0.0], [-6.0, -6.0, -6.0]])
        tolerance = 2e-3 * size * max(pair)
        assert deep == pytest.approx(-inside * size, abs=tolerance)
        assert far == pytest.approx(outside * size, abs=tolerance)
        assert result.info.background == pytest.approx(outside * size)
        assert widths_of(result, size) == pytest.approx(pair, rel=2e-3)
        _, values = active_voxels(dequantized(result))
        # The last layer of voxels within each width is there.
        assert -inside * size * 1.001 < values.min() < -(inside - 1.01) * size
        assert (outside - 1.01) * size < values.max() < outside * size * 1.001
        face = 2.0 + MOTION.get(name, 0.0)
        # The stencil of a sample reaches a voxel beyond its point.
        steps = np.linspace(-(inside - 1.0), outside - 1.0, 9) * size
        samples = result.sample(np.stack([0 * steps, 0 * steps + 0.013, face + steps], axis=1))
        assert samples == pytest.approx(steps, abs=0.1 * size)

    @pytest.mark.slow
    def test_segments(self, pair):
        two = gk.volume.union(cube(pair, half=1.52), gk.volume.from_mesh(far_mesh(), SIZE, half_width=pair))
        parts = gk.volume.segment(two)
        assert len(parts) == 2
        parts.sort(key=lambda part: part.sample([[0.0, 0.0, 0.0]])[0])
        for part, middle in zip(parts, ([0.0, 0, 0], [3.24, 0, 0]), strict=True):
            assert part.sample([middle])[0] == pytest.approx(-pair[1] * SIZE, abs=1e-3)
            assert part.info.background == pytest.approx(pair[0] * SIZE)
        # Between them lie two voxels: each part has its own distance there, as far as its band reaches.
        for part, distance in zip(parts, (0.08, 0.12), strict=True):
            gap = part.sample([[1.6, 0.01, 0.02]], order=0)[0]
            assert gap == pytest.approx(min(distance, pair[0] * SIZE), abs=0.012)

    def test_renormalize_takes_a_pair(self):
        result = gk.volume.renormalize(cube(3.0), half_width=(2.0, 7.0))
        assert widths_of(result, SIZE) == (2.0, 7.0)
        assert gk.volume.renormalize(result, half_width=4.0).sample([[0.0, 0, 0]])[0] == pytest.approx(-0.4)

    @pytest.mark.parametrize("bad", [(0.5, 3.0), (3.0, 300.0), (1.0, 2.0, 3.0), "wide", (np.nan, 2.0)])
    def test_renormalize_refuses_other_widths(self, bad):
        with pytest.raises(InputError, match="half_width"):
            gk.volume.renormalize(cube(3.0), half_width=bad)

    def test_a_band_of_another_width_has_it_on_both_sides(self, band):
        wide = with_band(band, SIZE, 8.0)
        assert widths_of(wide, SIZE) == (8.0, 8.0)
        points = np.stack([[0.013] * 13, [0.0] * 13, 2.0 + np.linspace(-0.6, 0.6, 13)], axis=1)
        assert wide.sample(points) == pytest.approx(points[:, 2] - 2.0, abs=0.05 * SIZE)

    @pytest.mark.slow
    def test_doubles_and_turned_voxels(self, pair):
        turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
        transform = np.eye(4)
        transform[:3, :3] = turn * SIZE
        turned = gk.volume.resample(cube(pair), transform=transform)
        moved = gk.volume.offset(turned, 0.05)
        assert moved.sample([[0.0, 0, 0]])[0] == pytest.approx(-pair[1] * SIZE, abs=1e-3)
        assert moved.sample([[0.0, 0, 2.05]])[0] == pytest.approx(0.0, abs=0.05 * SIZE)

    @pytest.mark.slow
    def test_voxels_that_are_no_cubes(self, pair):
        flat = np.diag([SIZE, SIZE, 0.5 * SIZE, 1.0])
        anisotropic = gk.volume.resample(cube(pair), transform=flat)
        assert np.sign(anisotropic.sample([[0.0, 0, 0], [3.5, 0, 0]])).tolist() == [-1.0, 1.0]
        back = gk.volume.resample(anisotropic, voxel_size=SIZE)
        assert back.sample([[0.0, 0.0, 2.0]])[0] == pytest.approx(0.0, abs=0.05 * SIZE)
        assert widths_of(back, SIZE) == pytest.approx(pair, rel=0.02)

    @pytest.mark.slow
    @pytest.mark.parametrize("suffix", [".vdb", ".nvdb"])
    def test_files(self, band, pair, suffix, tmp_path):
        gk.volume.save(tmp_path / f"a{suffix}", band)
        loaded = gk.volume.load(tmp_path / f"a{suffix}")
        assert widths_of(loaded, SIZE) == pytest.approx(pair)
        assert gk.volume.offset(loaded, 0.01).sample([[0.0, 0, 0]])[0] == pytest.approx(-pair[1] * SIZE, abs=1e-3)

    @pytest.mark.slow
    def test_meshes_and_rays(self, band):
        moved = gk.volume.offset(band, 0.03)
        audit = gk.mesh.audit(gk.mesh.from_volume(moved))
        assert audit.watertight
        hit = moved.raycast([[0.0, 0.0, 6.0]], [[0.0, 0.0, -1.0]])
        assert hit.t[0] == pytest.approx(6.0 - 2.03, abs=0.02 * SIZE)


def far_mesh():
    return gk.mesh.box(3 * [3.04], center=(3.24, 0.0, 0.0))
