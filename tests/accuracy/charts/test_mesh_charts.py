"""Charts of meshes: every trial runs with right answers, and a method made worse on purpose is detected."""

from __future__ import annotations

import dataclasses
import math
from unittest import mock

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog import mesh_catalog
from geokit.accuracy.charts import closest_point, first_hit, mesh_setup
from geokit.accuracy.charts.makers import mesh_charts
from geokit.accuracy.charts.mesh_setup import MeshSetup
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Subject, Trial
from geokit.accuracy.trials.running import held_bytes
from geokit.errors import InputError
from geokit.mesh import Surface, TriangleMesh

SIGNS = ["sign", "sign_hole", "sign_flips", "sign_doubles"]
NAMES = ["closest_point", "closest_point_near", *SIGNS, "first_hit", "first_hit_edges", "normals"]
# Shares of the diagonal: float64 keeps some roundings, float32 some of its own.
DOUBLE, SINGLE = 1e-14, 1e-6
COUNT = 600


@pytest.fixture(autouse=True)
def few_queries(monkeypatch):
    monkeypatch.setattr(mesh_setup, "COUNTS", {"cpu": (COUNT, 2 * COUNT), "cuda": (COUNT, 2 * COUNT)})


def charts_of(mesh: TriangleMesh, quick: bool = True) -> dict[str, Chart]:
    return {chart.name: chart for chart in mesh_charts(Subject(mesh.name, mesh=mesh), "cpu", quick)}


def judged(trial: Trial):
    judgement = trial.judge(trial.run())
    assert judgement.errors.shape == judgement.wrong.shape == (len(judgement.positions),)
    assert len(judgement.errors) > 0
    assert np.isfinite(judgement.errors).all()
    assert (judgement.errors >= 0.0).all()
    return judgement


@pytest.fixture(scope="module")
def sphere():
    return mesh_catalog.icosphere(2)


def test_names_and_order(sphere):
    charts = charts_of(sphere, quick=False)
    assert list(charts) == NAMES
    assert [name for name, chart in charts.items() if chart.vertical == "wrong"] == [*SIGNS, "first_hit_edges"]
    assert list(charts_of(sphere)) == [name for name in NAMES if name != "sign_doubles"]
    assert charts["normals"].unit == "degrees"


def test_an_open_mesh_has_no_normals_to_read_from_a_field():
    assert list(charts_of(mesh_catalog.holed_sphere(), quick=False)) == NAMES[:-1]


@pytest.mark.parametrize(
    "subject",
    [
        Subject("cloud", points=np.zeros((3, 3))),
        Subject("empty", mesh=TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), int))),
    ],
)
def test_a_subject_without_faces_is_refused(subject):
    with pytest.raises(InputError, match="has no mesh with faces"):
        mesh_charts(subject, "cpu", True)


def test_nothing_is_made_before_it_is_asked_for(sphere):
    with mock.patch.object(Surface, "__init__", side_effect=AssertionError("made")):
        charts = charts_of(sphere)
        with pytest.raises(AssertionError, match="made"):
            next(iter(charts["closest_point"].trials()))


@pytest.mark.parametrize("name", ["closest_point", "closest_point_near"])
def test_closest_points(sphere, name):
    for trial in charts_of(sphere)[name].trials():
        judgement = judged(trial)
        assert not judgement.wrong.any()
        bound = (DOUBLE if "float64" in trial.method else SINGLE) * sphere.diagonal
        assert judgement.errors.max() <= bound
        if "float32" in trial.method:
            assert judgement.errors.max() > DOUBLE * sphere.diagonal
        assert (trial.byte_count > 0) == ("made" not in trial.method)
        assert trial.count == COUNT
        assert trial.setting == f"max_distance={trial.parameters['max_distance']!r}"
        near = reference.closest_point(sphere.vertices, sphere.faces, judgement.positions).distance
        if name == "closest_point_near":
            assert near.max() <= 0.011 * sphere.diagonal
        else:
            assert near.max() > 0.05 * sphere.diagonal


def test_search_radii_are_searched(sphere):
    # Otherwise the chart would show the same method three times.
    trials = [t for t in charts_of(sphere)["closest_point"].trials() if t.method == "closest_point, float64"]
    assert [t.parameters["max_distance"] for t in trials[:1]] == [math.inf]
    misses = [(t.run().triangle_id.numpy() < 0).sum() for t in trials]
    assert misses[0] == 0
    assert 0 < misses[1] < misses[2] < COUNT


def test_signs_of_a_clean_mesh(sphere):
    chart = charts_of(sphere)["sign"]
    inside = []
    for trial in chart.trials():
        judgement = judged(trial)
        assert not judgement.wrong.any(), trial.method
        inside.append(np.mean(np.linalg.norm(judgement.positions, axis=1) < 1.0))
    assert len(inside) == 4
    assert 0.1 < inside[0] < 0.9


def test_signs_of_a_mesh_that_is_inside_out():
    # geokit orients before it signs: so does the reference.
    for trial in charts_of(mesh_catalog.inside_out_box())["sign"].trials():
        assert not judged(trial).wrong.any(), trial.method


def test_signs_of_an_open_mesh_leave_out_what_may_be_either(monkeypatch):
    monkeypatch.setattr(mesh_setup, "COUNTS", {"cpu": (8 * COUNT, 8 * COUNT)})
    mesh = mesh_catalog.holed_sphere()
    trial = next(iter(charts_of(mesh)["sign"].trials()))
    judgement = judged(trial)
    winding = reference.winding_number(mesh.vertices, mesh.faces, judgement.positions)
    assert np.abs(winding - 0.5).min() > closest_point.AMBIGUOUS
    assert not judgement.wrong.any()


@pytest.mark.slow
def test_damage_shows_who_fails(monkeypatch):
    monkeypatch.setattr(mesh_setup, "COUNTS", {"cpu": (COUNT, 4 * COUNT)})
    charts = charts_of(mesh_catalog.torus(), quick=False)
    trials = {name: list(charts[f"sign_{name}"].trials()) for name in closest_point.DAMAGES}
    for some in trials.values():
        assert [t.parameters for t in some] == [{"sign": sign} for sign in closest_point.METHODS]
    shares = {(t.parameters["sign"], name): judged(t).wrong.mean() for name, some in trials.items() for t in some}
    # Rays that leave through the hole, or pass two faces for one, count wrong; winding numbers hardly notice.
    assert shares["parity", "hole"] > 0.0
    assert shares["parity", "doubles"] > 0.0
    assert shares["winding", "hole"] < 0.05
    assert shares["winding", "flips"] == 0.0
    assert max(shares.values()) < 0.5


def test_damage_is_what_it_says():
    torus = mesh_catalog.torus()
    area = np.linalg.norm(np.cross(*_edges(torus)), axis=1).sum()
    holed = closest_point.damaged(torus, "hole")
    left = np.linalg.norm(np.cross(*_edges(holed)), axis=1).sum()
    assert 0.03 <= 1.0 - left / area < 0.035
    flipped = closest_point.damaged(torus, "flips").faces
    turned = (flipped != torus.faces).any(axis=1)
    assert turned.sum() == math.ceil(0.1 * len(torus.faces))
    np.testing.assert_array_equal(np.sort(flipped, axis=1), np.sort(torus.faces, axis=1))
    doubled = closest_point.damaged(torus, "doubles").faces
    np.testing.assert_array_equal(doubled[: len(torus.faces)], torus.faces)
    assert len(doubled) == math.ceil(1.1 * len(torus.faces))
    assert len(np.unique(doubled, axis=0)) == len(torus.faces)


def _edges(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return b - a, c - a


def test_first_hits(sphere):
    found = {}
    for trial in charts_of(sphere)["first_hit"].trials():
        judgement = judged(trial)
        found[trial.method, trial.setting] = judgement
        if trial.method == "raycast":
            assert not judgement.wrong.any()
            assert judgement.errors.max() <= DOUBLE * sphere.diagonal
        elif trial.method.startswith("warp"):
            # A grazing ray slides along the surface by some ten times the displacement by float32.
            assert judgement.errors.max() <= 100 * SINGLE * sphere.diagonal
        assert trial.byte_count > 0
    volumes = [judgement for (method, _), judgement in found.items() if method == "volume.raycast"]
    assert len(volumes) == 2
    coarse, fine = (np.median(judgement.errors[~judgement.wrong]) for judgement in volumes)
    assert 0.0 < fine < 0.5 * coarse
    # Where rays should have hit, the picture shows the surface.
    radius = np.linalg.norm(volumes[0].positions, axis=1)
    assert ((radius < 1.0 + 1e-9) & (radius > 0.9)).mean() > 0.2


def test_hits_elsewhere_are_wrong(sphere):
    setup = MeshSetup(sphere, "cpu", True)
    trial = next(iter(first_hit.first_hit_charts(setup)[0].trials()))
    answer = trial.run()
    t = answer.t.numpy()
    rows = setup.rows()
    hit, miss = rows[np.isfinite(t[rows])], rows[np.isinf(t[rows])]
    t[hit[0]] += 0.021 * sphere.diagonal
    t[hit[1]] += 0.019 * sphere.diagonal
    t[hit[2]] = np.inf
    t[hit[3]] = np.nan
    t[miss[0]] = 1.0
    judgement = trial.judge(answer._replace(t=wp.array(t)))
    expected = np.isin(rows, [hit[0], hit[2], hit[3], miss[0]])
    np.testing.assert_array_equal(judgement.wrong, expected)
    assert judgement.errors.max() == pytest.approx(0.019 * sphere.diagonal, rel=1e-6)


def test_rays_at_edges_do_not_leak(sphere):
    trials = list(charts_of(sphere)["first_hit_edges"].trials())
    first = judged(trials[0])
    assert trials[0].method == "raycast"
    assert not first.wrong.any()
    # Silhouettes are left out; all other rays hit their target or something before it.
    assert 0.5 * COUNT < len(first.errors) < COUNT
    normals = first.positions / np.linalg.norm(first.positions, axis=1, keepdims=True)
    assert np.linalg.norm(first.positions - normals, axis=1).max() < 0.1


def test_the_rays_at_edges_find_the_leaks_of_boxes_that_are_not_padded(monkeypatch):
    monkeypatch.setattr(mesh_setup, "COUNTS", {"cpu": (8 * COUNT, 8 * COUNT)})
    shares = {
        trial.method: judged(trial).wrong.mean() for trial in charts_of(mesh_catalog.box())["first_hit_edges"].trials()
    }
    assert shares["raycast"] == 0.0
    assert 0.0 < shares["warp.mesh_query_ray, float32"] < 0.02


def test_of_a_single_triangle_no_edge_is_inside():
    assert not list(charts_of(mesh_catalog.single_triangle())["first_hit_edges"].trials())


@pytest.mark.slow
@pytest.mark.parametrize("make", [mesh_catalog.open_shell, mesh_catalog.sliver_fan, mesh_catalog.three_on_an_edge])
def test_rays_at_the_rims_of_open_meshes_are_left_out(make):
    trials = charts_of(make())["first_hit_edges"].trials()
    assert not any(judged(trial).wrong.any() for trial in trials if trial.method == "raycast")


def test_normals_from_a_level_set_improve_with_the_voxels(sphere):
    median = {}
    for trial in charts_of(sphere)["normals"].trials():
        judgement = judged(trial)
        assert not judgement.wrong.any()
        assert judgement.errors.max() < 45.0
        median[trial.parameters["order"], trial.parameters["voxel_size"]] = np.median(judgement.errors)
    sizes = sorted({size for _, size in median})
    assert len(median) == 8
    for order in range(4):
        assert median[order, sizes[0]] < median[order, sizes[1]]


def test_normals_of_faces_that_wind_inward_are_turned():
    for trial in charts_of(mesh_catalog.inside_out_box())["normals"].trials():
        assert np.median(judged(trial).errors) < 1.0


def test_the_reference_is_computed_once_for_a_chart(sphere):
    ask = reference.closest_point
    with mock.patch.object(reference, "closest_point", side_effect=ask) as asked:
        for trial in charts_of(sphere)["closest_point"].trials():
            trial.judge(trial.run())
        assert asked.call_count == 1
    count = reference.winding_number
    with mock.patch.object(reference, "winding_number", side_effect=count) as asked:
        charts = charts_of(sphere)
        for trial in [*charts["sign"].trials(), *charts["sign_hole"].trials(), *charts["sign_flips"].trials()]:
            trial.judge(trial.run())
        assert asked.call_count == 1


def test_a_closest_point_made_worse_is_noticed(sphere):
    setup = MeshSetup(sphere, "cpu", True)
    trial = next(iter(charts_of(sphere)["closest_point"].trials()))
    rows, answer = setup.rows(), trial.run()
    step = 1e-6 * sphere.diagonal
    distance, points, triangle = answer.distance.numpy(), answer.points.numpy(), answer.triangle_id.numpy()
    away = points[rows[1]] - setup.uniform().points[rows[1]]

    def with_(**parts):
        return trial.judge(answer._replace(**{name: wp.array(part) for name, part in parts.items()}))

    moved = distance.copy()
    moved[rows[0]] += step
    judgement = with_(distance=moved)
    assert judgement.errors[0] == pytest.approx(step, rel=1e-6)
    assert judgement.errors[1:].max() <= DOUBLE * sphere.diagonal
    # A point beside the one whose distance is returned.
    moved = points.copy()
    moved[rows[1]] += step * away / np.linalg.norm(away)
    assert with_(points=moved).errors[1] == pytest.approx(step, rel=1e-6)
    missed = triangle.copy()
    missed[rows[2]] = -1
    assert np.flatnonzero(with_(triangle_id=missed).wrong).tolist() == [2]
    broken = distance.copy()
    broken[rows[3]] = np.nan
    assert np.flatnonzero(with_(distance=broken).wrong).tolist() == [3]


def test_a_flipped_sign_is_noticed(sphere):
    trial = next(iter(charts_of(sphere)["sign"].trials()))
    answer = trial.run().numpy()
    rows = MeshSetup(sphere, "cpu", True).rows()
    flipped = answer.copy()
    flipped[rows[5]] = ~flipped[rows[5]]
    assert trial.judge(wp.array(flipped)).wrong.sum() == 1
    assert trial.judge(wp.array(~answer)).wrong.all()


def test_hits_beyond_the_search_radius_are_wrong(sphere):
    trials = list(charts_of(sphere)["closest_point"].trials())
    everywhere, within = trials[0], trials[1]
    judgement = within.judge(everywhere.run())
    near = reference.closest_point(sphere.vertices, sphere.faces, judgement.positions).distance
    np.testing.assert_array_equal(judgement.wrong, near > within.parameters["max_distance"])
    assert judgement.wrong.any()


def test_two_runs_ask_the_same(sphere):
    one, other = (list(charts_of(sphere)["first_hit"].trials()) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        first, second = a.judge(a.run()), b.judge(b.run())
        np.testing.assert_array_equal(first.errors, second.errors)
        np.testing.assert_array_equal(first.positions, second.positions)
        assert dataclasses.replace(a, run=b.run, judge=b.judge) == b


@pytest.mark.parametrize("make", mesh_catalog.CLOSED)
def test_closed_meshes_are_told(make):
    assert MeshSetup(make(), "cpu", True).is_closed


@pytest.mark.parametrize("make", mesh_catalog.OPEN)
def test_open_meshes_are_told(make):
    assert not MeshSetup(make(), "cpu", True).is_closed


def test_large_meshes_are_checked_less():
    few, many = (MeshSetup(mesh_catalog.icosphere(level), "cpu", False) for level in (0, 5))
    with mock.patch.object(mesh_setup, "COUNTS", {"cpu": (10**6, 10**6)}):
        few, many = (MeshSetup(setup.mesh, "cpu", True) for setup in (few, many))
    assert few.checked_count() == mesh_setup.MOST
    assert many.checked_count() == mesh_setup.QUICK_PAIRS // 20480
    assert many.checked_count(10**6) == mesh_setup.LEAST


def test_held_bytes_counts_each_array_once():
    array, other = wp.zeros(10, dtype=wp.float64, device="cpu"), wp.zeros(3, dtype=wp.vec3f, device="cpu")

    class Holder:
        def __init__(self):
            self.mine, self.again, self.both = array, array, (array, [other])
            self.itself = self

    assert held_bytes(Holder(), array) == 80 + 36
    surface = Surface(mesh_catalog.box(), device="cpu")
    assert held_bytes(surface) > 12 * 3 * 24
