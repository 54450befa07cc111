"""Charts of volumes: their references are right, and answers made worse on purpose are detected."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import ROTATED, sphere
from benchmarks.catalog.typed_grids import TypedGrid
from geokit.accuracy.charts import sampling
from geokit.accuracy.charts.makers import mesh_volume_charts, volume_charts
from geokit.accuracy.charts.mesh_setup import area_samples
from geokit.accuracy.charts.sampling import REACH
from geokit.accuracy.charts.volume_raycast import _judge, _Rays, _reference
from geokit.accuracy.charts.volume_setup import Effort, NearSurface, VolumePoints, known_codecs, surface_samples
from geokit.accuracy.reference.volume import (
    Voxels,
    axis_weights,
    first_level,
    interpolant,
    interpolant_gradient,
    nearest_to_level,
)
from geokit.accuracy.stability.shapes import box, icosphere, moved, sphere_distance, without_cap
from geokit.accuracy.trials.model import Subject
from geokit.accuracy.trials.running import angles
from geokit.errors import InputError, UnsupportedGridError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.volume._dense import from_dense
from geokit.volume.distance_fields.from_mesh import from_mesh
from tests.support.reference import box_distance

LOWER, UPPER = (-1.0, -0.7, -0.4), (0.8, 0.6, 0.5)
SMALL = Effort(queries=500, rays=200, checked=120, checked_rays=24, divisions=(12, 30))


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few queries and large voxels: what is tested does not depend on how many there are."""
    monkeypatch.setattr(Effort, "of", classmethod(lambda *_: SMALL))


def charts_of(given, quick=True):
    """The charts of a mesh or a volume by name."""
    if isinstance(given, TriangleMesh):
        made = mesh_volume_charts(Subject("it", mesh=given), "cpu", quick)
    else:
        made = volume_charts(Subject("it", volume=given), "cpu", quick)
    return {chart.name: chart for chart in made}


def trials_of(chart, **wanted):
    """Its trials whose parameters are these."""
    return [t for t in chart.trials() if all(t.parameters[name] == value for name, value in wanted.items())]


def fog():
    """A Gaussian blob of 24^3 voxels."""
    x = np.stack(np.meshgrid(*3 * [np.linspace(-2, 2, 24)], indexing="ij"), axis=-1)
    return from_dense(np.exp(-(x * x).sum(axis=-1)), voxel_size=0.1, tolerance=0.01, grid_class="fog volume")


class TestVoxels:
    def test_values_of_leaves_tiles_and_background(self):
        grid = TypedGrid("float")
        ijk = np.concatenate(
            [
                np.random.default_rng(0).integers(-20, 40, (500, 3)),
                [[0, 0, 8], [7, 7, 15], [0, 0, 16], [0, 0, 128], [127, 127, 255], [4096, 0, 0], [8192, 0, 0]],
                [[-4096, 0, 0], [-(2**31), 0, 0], [2**31 - 1, 5, 5]],
            ]
        )
        np.testing.assert_array_equal(Voxels(grid.volume)(ijk), grid.at(ijk))

    def test_active_voxels(self):
        volume = sphere(9.0)
        voxels = Voxels(volume)
        drawn = voxels.draw_active(10**6, 0)
        assert len(np.unique(drawn, axis=0)) == len(drawn) == volume.info.active_voxel_count
        values, active = voxels.leaf_values(drawn)
        assert active.all()
        np.testing.assert_allclose(values, np.linalg.norm(drawn, axis=1) - 9.0, atol=1e-6)
        assert not voxels.leaf_values(np.array([[0, 0, 0], [100, 0, 0], [9, 9, 9]]))[1].any()
        assert len(voxels.draw_active(50, 0)) == 50

    def test_other_types_are_refused(self):
        with pytest.raises(UnsupportedGridError, match="float"):
            Voxels(TypedGrid("double").volume)

    def test_without_leaves(self):
        voxels = Voxels(from_dense(np.zeros((8, 8, 8)), voxel_size=1.0, background=0.0))
        assert len(voxels.draw_active(5, 0)) == 0
        np.testing.assert_array_equal(voxels(np.array([[0, 0, 0]])), 0.0)

    def test_world_gradient_of_a_turned_grid(self):
        # A linear field in index space: its world gradient is the row vector times the inverse of the linear part.
        voxels = Voxels(sphere(9.0, transform=ROTATED))
        slope = np.array([0.3, -0.2, 0.5])
        linear = ROTATED[:3, :3]
        voxels._walk = lambda ijk: (ijk @ slope, None, None)  # type: ignore[method-assign]
        points = voxels.to_world(np.random.default_rng(1).uniform(-5, 5, (20, 3)))
        for order in range(4):
            np.testing.assert_allclose(voxels.gradient(points, order) @ linear, np.tile(slope, (20, 1)), atol=1e-9)


class TestInterpolants:
    @staticmethod
    def quadratic(u):
        x, y, z = np.asarray(u, float).T
        return 1.0 + 2.0 * x - y + 0.5 * x * y + 0.25 * z * z - 0.125 * x * x

    @pytest.mark.parametrize("order", [2, 3])
    def test_quadratic_fields_are_reproduced(self, order):
        u = np.random.default_rng(2).uniform(-9, 9, (50, 3))
        np.testing.assert_allclose(interpolant(self.quadratic, u, order), self.quadratic(u), atol=1e-12)
        x, y, z = u.T
        wanted = np.stack([2.0 + 0.5 * y - 0.25 * x, -1.0 + 0.5 * x, 0.5 * z], axis=1)
        np.testing.assert_allclose(interpolant_gradient(self.quadratic, u, order), wanted, atol=1e-12)

    def test_order_1_is_the_mean_of_the_corners_in_the_middle(self):
        values = np.random.default_rng(3).normal(size=8)

        def at(ijk):
            return values[ijk @ [4, 2, 1]]

        assert interpolant(at, np.full((1, 3), 0.5), 1)[0] == pytest.approx(values.mean())
        wanted = values.reshape(2, 2, 2).mean(axis=(1, 2))
        assert interpolant_gradient(at, np.full((1, 3), 0.5), 1)[0, 0] == pytest.approx(wanted[1] - wanted[0])

    def test_order_0_rounds_halves_up_and_takes_central_differences(self):
        def at(ijk):
            return (ijk[:, 0] ** 2).astype(float)

        u = np.array([[1.5, 0.0, 0.0], [1.49, 0.0, 0.0], [-0.5, 0.0, 0.0]])
        np.testing.assert_array_equal(interpolant(at, u, 0), [4.0, 1.0, 0.0])
        np.testing.assert_array_equal(interpolant_gradient(at, u, 0)[:, 0], [4.0, 2.0, 0.0])

    @pytest.mark.parametrize("order", [1, 2, 3])
    def test_weights_add_up_to_one(self, order):
        t = np.linspace(0.0, 1.0, 7)
        np.testing.assert_allclose(axis_weights(order, t).sum(axis=1), 1.0, atol=1e-14)

    def test_first_level_of_a_plane(self):
        def at(ijk):
            return ijk[:, 0].astype(float)

        assert first_level(at, np.zeros(3), np.array([0.5, 0.2, 0.0]), 1.7, 0.0, 10.0) == pytest.approx(3.4, abs=1e-12)
        assert first_level(at, np.zeros(3), np.array([0.0, 1.0, 0.0]), 1.7, 0.0, 10.0) == np.inf

    def test_distance_to_a_level(self):
        voxels = Voxels(sphere(20.0))
        points = np.array([[20.4, 0.3, 0.1], [0.0, -19.2, 0.0], [40.0, 0.0, 0.0]])
        hit = nearest_to_level(voxels, points, 0.0, 1e-3)
        np.testing.assert_allclose(hit.distance[:2], np.abs(np.linalg.norm(points[:2], axis=1) - 20.0), atol=0.02)
        assert hit.steep.tolist() == [True, True, False]


class TestNearSurface:
    def test_distances_are_those_of_the_box(self):
        near = NearSurface(box(LOWER, UPPER), "cpu", True)
        known = near.known
        np.testing.assert_allclose(known.distance, box_distance(known.points, LOWER, UPPER), rtol=0, atol=1e-13)
        assert (known.distance < 0).any()
        assert (known.distance > 0).any()
        assert np.abs(box_distance(near.points, LOWER, UPPER)).max() <= 0.5 * min(near.voxel_sizes) * (1 + 1e-9)
        np.testing.assert_array_equal(near.points[known.rows], known.points)

    def test_wrongly_wound_faces_do_not_turn_signs(self):
        mesh = box(LOWER, UPPER)
        faces = mesh.faces.copy()
        faces[::3] = faces[::3, ::-1]
        known = NearSurface(TriangleMesh(mesh.vertices, faces), "cpu", True).known
        np.testing.assert_array_equal(np.sign(known.distance), np.sign(box_distance(known.points, LOWER, UPPER)))

    def test_no_side_is_asked_for_in_the_mouth_of_an_open_mesh(self):
        # A cube without its lid: from the middle of the missing side it spans half of all directions.
        mesh = box()
        open_mesh = TriangleMesh(mesh.vertices, mesh.faces[(mesh.vertices[mesh.faces][:, :, 2] < 0.5).any(axis=1)])
        points = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.49], [0.0, 0.0, -0.4], [0.0, 0.0, 3.0]])
        known = NearSurface(open_mesh, "cpu", True).truth(points, np.arange(4))
        assert known.rows.tolist() == [2, 3]
        np.testing.assert_allclose(known.distance, [-0.1, np.hypot(2.5, 0.5)], rtol=1e-14)

    def test_samples_are_on_the_surface_and_even(self):
        rng = np.random.default_rng(4)
        points, face = area_samples(box(LOWER, UPPER), 6000, rng)
        np.testing.assert_allclose(box_distance(points, LOWER, UPPER), 0.0, atol=1e-15)
        size = np.subtract(UPPER, LOWER)
        share = size[0] * size[1] / (size[0] * size[1] + size[1] * size[2] + size[0] * size[2]) / 2
        assert np.mean(points[:, 2] == LOWER[2]) == pytest.approx(share, abs=4 * np.sqrt(share / 6000))
        assert set(face) == set(range(12))

    def test_samples_hold_the_corners(self):
        samples = surface_samples(box(LOWER, UPPER), 100, 0)
        assert len(samples) == 100
        corners = {tuple(v) for v in box(LOWER, UPPER).vertices}
        assert corners <= {tuple(p) for p in samples}


class TestMeshCharts:
    @pytest.mark.slow
    def test_every_trial_is_run_and_judged(self):
        for chart in charts_of(icosphere(2)).values():
            trials = list(chart.trials())
            assert trials, chart.name
            for trial in trials:
                judgement = trial.judge(trial.run())
                assert len(judgement.errors) == len(judgement.wrong) == len(judgement.positions) > 0
                assert np.isfinite(judgement.errors).all()
                assert (judgement.errors >= 0).all()
                assert not judgement.wrong.any(), (chart.name, trial.setting)
                assert trial.count > 0
                assert trial.byte_count > 0
                assert set(trial.parameters) >= {"voxel_size"}

    def test_sampling_of_a_sphere(self):
        chart = charts_of(icosphere(3))["sdf_sampling"]
        worst = {}
        for trial in chart.trials():
            assert set(trial.parameters) == {"voxel_size", "order", "codec"}
            worst[tuple(trial.parameters.values())] = (trial.judge(trial.run()).errors.max(), trial.byte_count)
        size = min(voxel_size for voxel_size, _, _ in worst)
        errors = {key[1:]: error for key, (error, _) in worst.items() if key[0] == size}
        # Half the diagonal of a voxel for order 0, and the bends of the facets for order 3.
        assert 0.1 * size < errors[0, "float"] <= 0.87 * size
        assert errors[3, "float"] < errors[1, "float"] < 0.1 * size
        assert errors[1, "float"] < errors[1, "fp4"]
        sizes = {key[2]: byte_count for key, (_, byte_count) in worst.items() if key[0] == size}
        assert sizes["fp4"] < sizes["fp8"] < sizes["fp16"] < sizes["float"]

    def test_from_mesh_is_exact_and_a_wrong_one_is_seen(self):
        mesh = icosphere(2)
        trial = trials_of(charts_of(mesh)["from_mesh"], method="geokit", half_width=3.0)[0]
        answer = trial.run()
        # A rounding of float32 of distances up to half the diagonal.
        assert trial.judge(answer).errors.max() < 2**-24 * mesh.diagonal
        size = trial.parameters["voxel_size"]
        off = trial.judge(from_mesh(moved(mesh, (0.01 * size, 0.0, 0.0)), size, device="cpu"))
        assert 0.009 * size < off.errors.max() < 0.011 * size
        inside_out = trial.judge(from_mesh(mesh, size, sign="none", device="cpu"))
        assert 0.2 < inside_out.wrong.mean() < 0.8
        narrow = trial.judge(from_mesh(mesh, size, half_width=1.5, device="cpu"))
        assert narrow.wrong.any()
        assert trial.count == answer.info.active_voxel_count

    def test_openvdb_is_there_for_closed_meshes(self):
        from geokit import native

        methods = {trial.parameters["method"] for trial in charts_of(icosphere(2))["from_mesh"].trials()}
        assert methods == ({"geokit", "openvdb"} if native.available() else {"geokit"})
        opened = charts_of(without_cap(icosphere(2), 0.2))["from_mesh"].trials()
        assert {trial.parameters["method"] for trial in opened} == {"geokit"}

    def test_from_volume_sees_both_directions(self):
        mesh = box(LOWER, UPPER)
        trial = trials_of(charts_of(mesh)["from_volume"], method="dual_contouring")[-1]
        good = trial.judge(trial.run())
        assert good.errors.max() < 0.1 * trial.parameters["voxel_size"]
        # Half a box is on the box: only the way from the box to it is long. With a needle it is the other way.
        half = TriangleMesh(mesh.vertices, mesh.faces[:6])
        assert trial.judge(half).errors.max() > 0.3
        needle = TriangleMesh(
            np.concatenate([mesh.vertices, [[5.0, 0, 0], [5.0, 1e-3, 0]]]), np.concatenate([mesh.faces, [[0, 8, 9]]])
        )
        assert trial.judge(needle).errors.max() > 3.0
        empty = trial.judge(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
        assert empty.wrong.all()

    def test_gradients_are_judged_away_from_edges(self):
        mesh = box(LOWER, UPPER)
        for trial in charts_of(mesh)["sdf_gradients"].trials():
            answer = trial.run().numpy()
            judgement = trial.judge(answer)
            # On a flat face the stencil of no order sees anything else than a plane.
            assert judgement.errors.max() < 1e-4
            inner = np.minimum(judgement.positions - LOWER, UPPER - judgement.positions)
            second = np.sort(np.abs(inner), axis=1)[:, 1]
            assert second.min() >= (REACH - 1e-9) * trial.parameters["voxel_size"] / 2
            # A face's unit normal and the diagonal: 0.0283 across, 1.02 along, or 0.98 where it points back.
            turned = trial.judge(answer + 0.02)
            assert 1.58 < turned.errors.min() <= turned.errors.max() < 1.66
            assert trial.judge(-answer).errors.min() > 179.0
            assert trial.judge(0.0 * answer).wrong.all()

    def test_a_setting_that_cannot_be_made_is_told(self, monkeypatch):
        def refuse(volume, codec, value_range):
            if codec == "fp8":
                raise InputError("codec: no")
            return volume

        monkeypatch.setattr(sampling, "coded", refuse)
        trials = list(charts_of(icosphere(1))["sdf_sampling"].trials())
        bad = [trial for trial in trials if trial.parameters["codec"] == "fp8"]
        assert bad
        assert len(trials) > 2 * len(bad)
        with pytest.raises(InputError, match="codec: no"):
            bad[0].run()
        with pytest.raises(InputError, match="codec: no"):
            bad[0].judge(None)

    def test_all_settings_without_quick(self):
        settings = [trial.parameters for trial in charts_of(icosphere(1), quick=False)["sdf_sampling"].trials()]
        assert len(settings) == 2 * len(known_codecs()) * 4
        assert len({tuple(p.items()) for p in settings}) == len(settings)


class TestVolumeCharts:
    @pytest.mark.slow
    def test_every_trial_is_run_and_judged(self):
        for volume in (sphere(12.0, transform=ROTATED), fog()):
            for chart in charts_of(volume).values():
                for trial in chart.trials():
                    judgement = trial.judge(trial.run())
                    assert len(judgement.errors) == len(judgement.wrong) == len(judgement.positions) > 0
                    assert np.isfinite(judgement.errors).all()
                    assert trial.count > 0

    def test_only_level_sets_are_cast_rays_at(self):
        assert list(charts_of(sphere())) == ["sampling", "gradients", "isosurface", "volume_raycast"]
        assert list(charts_of(fog())) == ["sampling", "gradients", "isosurface"]
        assert charts_of(fog())["sampling"].unit == "relative"

    @pytest.mark.parametrize("make", [lambda: sphere(12.0), fog])
    def test_float_grids_show_roundings_and_codecs_their_steps(self, make):
        volume = make()
        for name in ("sampling", "gradients"):
            worst = {}
            for trial in charts_of(volume, quick=False)[name].trials():
                answer = trial.run().numpy()
                worst[tuple(trial.parameters.values())] = trial.judge(answer).errors.max()
                answer = answer.copy()
                answer[0] += 0.5
                assert trial.judge(answer).errors.max() > 0.05
                answer[0] = np.nan
                assert trial.judge(answer).wrong.tolist()[:2] == [True, False]
            for order in range(4):
                assert worst[order, "float"] < 1e-13
                assert 1e-13 < worst[order, "fp16"] < worst[order, "fp8"] < worst[order, "fp4"]

    def test_isosurfaces(self):
        chart = charts_of(sphere(12.0))["isosurface"]
        trials = {(t.parameters["method"], t.parameters["adaptivity"]): t for t in chart.trials()}
        exact = trials["marching_cubes", 0.0]
        answer = exact.run()
        assert exact.judge(answer).errors.max() < 1e-5
        assert exact.count == exact.parameters["triangle_count"] == len(answer.faces)
        larger = TriangleMesh(answer.vertices * (12.1 / 12.0), answer.faces)
        assert exact.judge(larger).errors.mean() == pytest.approx(0.1, rel=0.05)
        nets = trials["surface_nets", 0.0]
        assert 1e-4 < nets.judge(nets.run()).errors.max() < 0.1

    def test_the_level_of_a_fog_volume_is_its_median(self):
        field = VolumePoints(fog(), "cpu", True)
        trial = next(iter(charts_of(fog())["isosurface"].trials()))
        assert 0.01 < trial.parameters["isovalue"] == field.isovalue < 0.5

    @pytest.mark.slow
    def test_rays(self):
        trials = {
            t.parameters["codec"]: t for t in charts_of(sphere(12.0, transform=ROTATED))["volume_raycast"].trials()
        }
        exact = trials["float"]
        answer = exact.run()
        good = exact.judge(answer)
        # Coordinates of 5e6 have steps of 1e-9; a ray that grazes the surface shows a few hundred of them.
        assert good.errors.max() < 1e-6
        assert not good.wrong.any()
        assert trials["fp4"].judge(trials["fp4"].run()).errors.max() > 1e-4
        t = answer.t.numpy()
        assert np.isfinite(t).mean() > 0.5
        hit = np.flatnonzero(np.isfinite(t[: SMALL.checked_rays]))
        late = t.copy()
        late[hit[0]] += 0.25
        assert exact.judge(answer._replace(t=late)).errors.max() == pytest.approx(0.25, abs=1e-6)
        early = t.copy()
        early[hit[0]] -= 0.25
        assert exact.judge(answer._replace(t=early)).errors.max() == pytest.approx(0.25, abs=1e-6)
        missed = t.copy()
        missed[hit[0]] = np.inf
        assert exact.judge(answer._replace(t=missed)).wrong.sum() == 1
        all_hit = np.where(np.isfinite(t), t, 1.0)
        assert exact.judge(answer._replace(t=all_hit)).wrong.sum() == (~np.isfinite(t[: SMALL.checked_rays])).sum()

    def test_a_hit_that_the_march_overlooked_counts(self):
        # On the diagonal of a cell with -b beside, 1 and c at its ends the interpolant is below 0 for a hundredth of
        # the cell where b is little more than the root of c: between two of the steps.
        dense = np.full((16, 16, 16), 1.0)
        dense[8, 9, 8] = dense[9, 8, 8] = -1.1407
        dense[9, 9, 8], dense[12, 12, 8] = 1.3, -1.0
        volume = from_dense(dense, voxel_size=1.0, background=1.0, grid_class="level set")
        field = VolumePoints(volume, "cpu", True)
        rays = _Rays(np.array([[0.03, 0.03, 8.0]]), np.array([[1.0, 1.0, 0.0]]))
        wanted = _reference(field, rays, 1)
        found = volume.raycast(rays.origins, rays.directions, device="cpu").t
        assert 8.0 < found[0] < 9.0 < 11.0 < wanted[0] < 12.0
        judged = _judge(field, rays, found, wanted)
        assert judged.errors.tolist() == [0.0]
        assert not judged.wrong.any()

    def test_quantized_grids_are_judged_by_their_own_values(self):
        volume = sphere(12.0).quantize("fp8")
        trials = trials_of(charts_of(volume)["sampling"], codec="float", order=1)
        assert trials[0].judge(trials[0].run()).errors.max() < 1e-13

    def test_nothing_active_has_no_charts(self):
        empty = from_dense(np.zeros((8, 8, 8)), voxel_size=1.0, background=0.0)
        assert volume_charts(Subject("empty", volume=empty), "cpu", True) == []


class TestRefusals:
    def test_subjects_of_another_kind(self):
        with pytest.raises(InputError, match="no mesh with faces"):
            mesh_volume_charts(Subject("cloud", points=np.zeros((3, 3))), "cpu", True)
        with pytest.raises(InputError, match="no mesh with faces"):
            mesh_volume_charts(
                Subject("empty", mesh=TriangleMesh(np.zeros((1, 3)), np.zeros((0, 3), int))), "cpu", True
            )
        with pytest.raises(InputError, match="no volume"):
            volume_charts(Subject("mesh", mesh=box()), "cpu", True)

    @pytest.mark.parametrize("grid_type", ["int32", "vec3f", "half"])
    def test_values_that_are_no_fields(self, grid_type):
        with pytest.raises(UnsupportedGridError, match=grid_type):
            volume_charts(Subject("it", volume=TypedGrid(grid_type).volume), "cpu", True)


def test_angles():
    a = np.array([[1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    b = np.array([[2.0, 0, 0], [0, 3.0, 0], [-1.0, 0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(angles(a, b), [0.0, 90.0, 180.0, np.nan])


def test_sphere_against_the_mesh():
    # The facets of an icosphere of edge e lie within e^2 / 6 of the sphere; the reference must say so.
    near = NearSurface(icosphere(3), "cpu", True)
    off = sphere_distance(near.known.points) - near.known.distance
    assert np.abs(off).max() < 0.16**2 / 4


class TestEffort:
    def test_large_meshes_are_checked_less(self, monkeypatch):
        monkeypatch.undo()
        few, many = Effort.of("cpu", True, 10_000_000), Effort.of("cpu", True, 100)
        assert 0 < few.checked < many.checked
        assert Effort.of("cuda:0", True).queries > many.queries
        assert Effort.of("cpu", False).queries > many.queries
        assert len(Effort.of("cpu", False).divisions) > len(many.divisions)
