"""Charts of points: every trial runs with right answers, and a method made worse on purpose is detected."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import warp as wp

from geokit.accuracy.charts import points as charts
from geokit.accuracy.charts.makers import points_charts
from geokit.accuracy.charts.points import MAJOR, MINOR, PointsSetup, torus_cloud
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Subject, Trial
from geokit.errors import InputError

NAMES = ["neighbors", "nearest", "point_normals", "torus_normals", "downsample"]
# Of coordinates up to 1.4: float64 keeps some roundings, float32 some of its own.
DOUBLE, SINGLE = 1e-14, 1e-6
COUNT = 400


@pytest.fixture(autouse=True)
def few_queries(monkeypatch):
    monkeypatch.setattr(charts, "COUNTS", {"cpu": (COUNT, 2 * COUNT), "cuda": (COUNT, 2 * COUNT)})
    monkeypatch.setattr(charts, "TORUS_COUNTS", (1500, 3000))


@pytest.fixture(scope="module")
def cloud():
    return torus_cloud(2000)[0]


def charts_of(points, quick: bool = True) -> dict[str, Chart]:
    return {chart.name: chart for chart in points_charts(Subject("cloud", points=points), "cpu", quick)}


def judged(trial: Trial):
    judgement = trial.judge(trial.run())
    assert judgement.errors.shape == judgement.wrong.shape == (len(judgement.positions),)
    assert len(judgement.errors) > 0
    assert np.isfinite(judgement.errors).all()
    assert (judgement.errors >= 0.0).all()
    return judgement


def test_names_and_order(cloud):
    charts = charts_of(cloud)
    assert list(charts) == NAMES
    assert [name for name, chart in charts.items() if chart.vertical == "wrong"] == ["neighbors"]
    assert [name for name, chart in charts.items() if chart.unit == "degrees"] == ["point_normals", "torus_normals"]


@pytest.mark.parametrize("points", [None, np.zeros((7, 3))])
def test_a_subject_without_points_is_refused(points):
    with pytest.raises(InputError, match="has no points, or fewer than 8"):
        points_charts(Subject("cloud", points=points), "cpu", True)


@pytest.mark.parametrize("quick", [True, False])
def test_neighbors(cloud, quick):
    trials = list(charts_of(cloud, quick)["neighbors"].trials())
    settings = [(trial.method, trial.setting) for trial in trials]
    assert len(set(settings)) == len(settings) == (12 if quick else 14)
    for trial in trials:
        judgement = judged(trial)
        assert not judgement.wrong.any(), trial.method
        if "float32" not in trial.method:
            assert judgement.errors.max() <= DOUBLE
        assert judgement.errors.max() <= SINGLE
        assert (trial.byte_count > 0) == ("made" not in trial.method)
        assert trial.parameters["cell_size"] > 0.0
    searched = next(trial for trial in trials if trial.method == "radius_search, float32")
    assert searched.judge(searched.run()).errors.max() > DOUBLE


def test_nearest(cloud):
    found = {}
    for trial in charts_of(cloud)["nearest"].trials():
        judgement = judged(trial)
        found[trial.method, trial.parameters["k"]] = trial.run()
        if "float32" in trial.method:
            assert DOUBLE < judgement.errors.max() <= SINGLE
        else:
            assert not judgement.wrong.any(), trial.method
            assert judgement.errors.max() <= DOUBLE
        assert trial.byte_count > 0 or "made" in trial.method
    assert {k for _, k in found} == {1, 8, 32}
    # The radius cuts rows short, which the comparison has to take into account.
    assert (found["hybrid, float64", 8].indices.numpy() < 0).any()


def test_normals_against_planes(cloud):
    trials = list(charts_of(cloud, quick=False)["point_normals"].trials())
    assert [trial.parameters["k"] for trial in trials] == [8, 16, 32, 64]
    for trial in trials:
        judgement = judged(trial)
        assert not judgement.wrong.any()
        # (k + 128) roundings, over a gap of a thousandth and more.
        assert judgement.errors.max() <= np.degrees((64 + 128) * 2.0**-53 / charts.GAP)
        assert trial.count == len(cloud)


def test_clouds_smaller_than_a_neighborhood_have_fewer_charts_of_normals(cloud):
    trials = list(charts_of(cloud[:20])["point_normals"].trials())
    assert [trial.parameters["k"] for trial in trials] == [8]
    judged(trials[0])


def test_points_without_a_plane_have_no_normals_to_judge():
    # Two points, four times each: every neighborhood is a line.
    assert not list(charts_of(np.repeat([[0.0, 0, 0], [1.0, 0, 0]], 4, axis=0))["point_normals"].trials())


def test_normals_of_the_torus():
    with mock.patch.object(charts, "TORUS_COUNTS", (6000, 6000)):
        trials = list(charts_of(torus_cloud(100)[0])["torus_normals"].trials())
        found = {(t.parameters["k"], t.parameters["orientation"]): judged(t) for t in trials}
    assert set(found) == {(k, orientation) for k in (8, 32) for orientation in ("none", "propagation")}
    for (_, orientation), judgement in found.items():
        assert len(judgement.errors) == 6000
        assert judgement.wrong.mean() < 0.01
        assert 0.1 < np.median(judgement.errors) < 5.0
        if orientation == "none":
            assert not judgement.wrong.any()


def test_the_torus_is_one():
    points, normals = torus_cloud(5000, noise=0.0)
    assert len(points) == 5000
    ring = np.hypot(points[:, 0], points[:, 1]) - MAJOR
    np.testing.assert_allclose(np.hypot(ring, points[:, 2]), MINOR, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-15)
    center = points - MINOR * normals
    np.testing.assert_allclose(np.hypot(center[:, 0], center[:, 1]), MAJOR, atol=1e-15)
    # Evenly spread: the outer half has (pi R + 2 r) / (2 pi R) of the area.
    share = 0.5 + MINOR / (np.pi * MAJOR)
    assert np.mean(ring > 0.0) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 5000))


def test_downsampled_clouds(cloud, monkeypatch):
    monkeypatch.setattr(charts, "MOST", 200)
    trials = list(charts_of(cloud, quick=False)["downsample"].trials())
    assert len(trials) == 9
    for trial in trials:
        answer, judgement = trial.run(), judged(trial)
        kept = answer.points.numpy()
        assert len(kept) == trial.parameters["kept"]
        near = reference.k_nearest(kept, 1, judgement.positions)[0][:, 0]
        np.testing.assert_array_equal(judgement.errors, near)
        if "radius" in trial.parameters:
            assert judgement.errors.max() < trial.parameters["radius"]
        elif "voxel_size" in trial.parameters:
            assert judgement.errors.max() < np.sqrt(3.0) * trial.parameters["voxel_size"]
    counts = [trial.parameters["kept"] for trial in trials if "count" in trial.parameters]
    assert counts == [trial.parameters["kept"] for trial in trials if "radius" in trial.parameters]
    assert counts[0] > counts[1] > counts[2]


def test_of_large_clouds_a_part_is_thinned(cloud, monkeypatch):
    monkeypatch.setattr(charts, "LARGEST", {"cpu": (500, 700)})
    monkeypatch.setattr(charts, "QUICK_STEPS", (2.0,))
    for trial in charts_of(cloud)["downsample"].trials():
        assert trial.count == 500
        judged(trial)
    thinned = PointsSetup(cloud, "cpu", False).thinned
    assert len(thinned) == 700
    assert len(np.unique(np.concatenate([cloud, thinned]), axis=0)) == len(cloud)


def test_a_wrong_set_of_neighbors_is_noticed(cloud):
    setup = PointsSetup(cloud, "cpu", True)
    trial = next(t for t in charts_of(cloud)["neighbors"].trials() if t.method == "radius_search, float64")
    answer = trial.run()
    offsets, indices, distance = (part.numpy().copy() for part in answer)
    row = next(i for i in range(3, 50) if np.diff(offsets)[setup.rows[i]] > 1)
    first = offsets[setup.rows[row]]

    def with_(**parts):
        return trial.judge(answer._replace(**{name: wp.array(part) for name, part in parts.items()}))

    turned = indices.copy()
    end = offsets[setup.rows[row] + 1]
    turned[first:end] = indices[first:end][::-1]
    backward = distance.copy()
    backward[first:end] = distance[first:end][::-1]
    assert not with_(indices=turned, distance=backward).wrong.any()
    other = indices.copy()
    other[first] = next(j for j in range(len(cloud)) if j not in indices[first:end])
    assert np.flatnonzero(with_(indices=other).wrong).tolist() == [row]
    twice = indices.copy()
    twice[first] = twice[first + 1]
    assert np.flatnonzero(with_(indices=twice).wrong).tolist() == [row]
    longer = distance.copy()
    longer[first] += 1e-6
    judgement = with_(distance=longer)
    assert judgement.errors[row] == pytest.approx(1e-6, rel=1e-6)
    assert np.delete(judgement.errors, row).max() <= DOUBLE


def test_a_wrong_count_is_noticed(cloud):
    setup = PointsSetup(cloud, "cpu", True)
    trial = next(iter(charts_of(cloud)["neighbors"].trials()))
    counts = trial.run().numpy().copy()
    counts[setup.rows[7]] += 1
    assert np.flatnonzero(trial.judge(wp.array(counts)).wrong).tolist() == [7]


def test_a_wrong_nearest_point_is_noticed(cloud):
    setup = PointsSetup(cloud, "cpu", True)
    trial = list(charts_of(cloud)["nearest"].trials())[1]
    answer = trial.run()
    distance, indices = answer.distance.numpy().copy(), answer.indices.numpy().copy()
    indices[setup.rows[2], 7] = -1
    distance[setup.rows[4], 0] += 1e-6
    distance[setup.rows[6], 3] = np.nan
    judgement = trial.judge(answer._replace(distance=wp.array(distance), indices=wp.array(indices)))
    assert np.flatnonzero(judgement.wrong).tolist() == [2, 6]
    assert judgement.errors[4] == pytest.approx(1e-6, rel=1e-6)


def test_normals_that_look_inward_are_wrong_where_they_are_oriented():
    trials = list(charts_of(torus_cloud(100)[0])["torus_normals"].trials())
    for trial in trials[:2]:
        answer = trial.run()
        inward = answer._replace(normals=wp.array(-answer.normals.numpy(), dtype=wp.vec3d))
        one, other = trial.judge(answer), trial.judge(inward)
        if trial.parameters["orientation"] == "none":
            np.testing.assert_allclose(one.errors, other.errors, atol=1e-9)
        else:
            np.testing.assert_array_equal(one.wrong, ~other.wrong)


def test_the_reference_is_computed_once_for_a_chart(cloud):
    within = reference.neighbors_within
    with mock.patch.object(reference, "neighbors_within", side_effect=within) as asked:
        for trial in charts_of(cloud)["neighbors"].trials():
            trial.judge(trial.run())
        assert asked.call_count == 1
    nearest = reference.k_nearest
    with mock.patch.object(reference, "k_nearest", side_effect=nearest) as asked:
        for trial in charts_of(cloud)["nearest"].trials():
            trial.judge(trial.run())
        assert asked.call_count == 1


def test_two_runs_ask_the_same(cloud):
    one, other = (next(iter(charts_of(cloud)["nearest"].trials())) for _ in range(2))
    first, second = one.judge(one.run()), other.judge(other.run())
    np.testing.assert_array_equal(first.errors, second.errors)
    np.testing.assert_array_equal(first.positions, second.positions)


def test_large_clouds_are_checked_less():
    setup = PointsSetup(np.zeros((10, 3)), "cpu", True)
    assert len(setup.choose(10**6, 10)) == charts.MOST
    assert len(setup.choose(10**6, 10**5)) == 100
    assert len(setup.choose(10**6, 10**9)) == charts.LEAST
    assert len(setup.choose(5, 10)) == 5
