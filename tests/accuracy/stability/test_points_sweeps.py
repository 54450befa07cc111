"""Sweeps of points: their structure, and that each detects a method made worse on purpose."""

from __future__ import annotations

import re
from importlib import import_module

import numpy as np
import pytest

from geokit.accuracy.stability import points_sweeps as points
from geokit.accuracy.stability.follow_sweeps import sweeps_of
from geokit.errors import InputError
from geokit.points import NeighborGrid

SWEEPS = {sweep.name: sweep for sweep in sweeps_of("points", "cpu")}
NO_FAILURE = "no failure found"
SEARCHES = [
    lambda: points.radii(2.0, device="cpu"),
    lambda: points.crowds(0.5, device="cpu"),
    lambda: points.extents(4.0, device="cpu"),
    lambda: points.duplicates(10.0, device="cpu"),
]
SEARCH_NAMES = ["radii", "crowds", "extents", "duplicates"]


def test_names():
    assert len(SWEEPS) == len(sweeps_of("points", "cpu"))
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", name) for name in SWEEPS)


@pytest.mark.parametrize("name", SWEEPS)
def test_values_lead_through_the_envelope(name):
    sweep = SWEEPS[name]
    steps = np.sign(np.diff(sweep.values))
    assert (steps == steps[0]).all()
    assert steps[0] != 0
    last = sweep.values.index(sweep.envelope.last)
    assert last >= 1
    assert (last + 1 < len(sweep.values)) != (NO_FAILURE in sweep.envelope.statement)
    assert 0.0 < sweep.envelope.error < np.inf
    assert sweep.envelope.statement.endswith(".")
    assert not sweep.logarithmic or min(sweep.values) > 0.0


@pytest.mark.parametrize("name", [name for name in SWEEPS if not name.startswith("register")])
def test_answers_are_the_same_every_time(name):
    sweep = SWEEPS[name]
    judgement, again = (sweep.ask(sweep.values[0]) for _ in range(2))
    assert judgement.errors.shape == judgement.wrong.shape
    assert judgement.positions.shape == (len(judgement.errors), 3)
    np.testing.assert_array_equal(judgement.errors, again.errors)
    np.testing.assert_array_equal(judgement.wrong, again.wrong)
    np.testing.assert_array_equal(judgement.positions, again.positions)


class TestNotices:
    """Each method is replaced by a worse one."""

    @pytest.mark.parametrize("ask", SEARCHES, ids=SEARCH_NAMES)
    def test_a_wrong_neighbor(self, monkeypatch, ask):
        exact = NeighborGrid.radius_search

        def worse(*given, **named):
            found = exact(*given, **named)
            indices = found.indices.copy()
            indices[0] += 1
            return found._replace(indices=indices)

        monkeypatch.setattr(NeighborGrid, "radius_search", worse)
        judgement = ask()
        assert judgement.wrong[0]
        assert not judgement.wrong[1:].any()

    @pytest.mark.parametrize("ask", SEARCHES, ids=SEARCH_NAMES)
    def test_a_wrong_count(self, monkeypatch, ask):
        exact = NeighborGrid.count
        monkeypatch.setattr(NeighborGrid, "count", lambda *given, **named: exact(*given, **named) + 1)
        assert ask().wrong.all()

    def test_distances_that_are_rounded(self, monkeypatch):
        exact = NeighborGrid.radius_search

        def worse(*given, **named):
            found = exact(*given, **named)
            return found._replace(distance=found.distance.astype(np.float32))

        monkeypatch.setattr(NeighborGrid, "radius_search", worse)
        judgement = points.radii(2.0, device="cpu")
        assert not judgement.wrong.any()
        assert judgement.errors.max() > 1e-9

    def test_nearest_points_in_another_order(self, monkeypatch):
        exact = NeighborGrid.knn

        def worse(*given, **named):
            found = exact(*given, **named)
            return found._replace(indices=found.indices[:, ::-1], distance=found.distance * (1.0 + 1e-12))

        monkeypatch.setattr(NeighborGrid, "knn", worse)
        judgement = points.nearest(8.0, device="cpu")
        assert judgement.wrong.all()
        assert judgement.errors.max() == pytest.approx(1e-12, rel=1e-2)

    def test_more_neighbors_than_there_may_be_are_refused(self):
        with pytest.raises(InputError, match="from 1 to 1024"):
            points.nearest(1025.0, device="cpu")

    def test_normals_that_are_tilted_or_missing(self, monkeypatch):
        module = import_module("geokit.points._normals")
        exact = module.normals
        c, s = np.cos(np.radians(5.0)), np.sin(np.radians(5.0))

        def worse(*given, **named):
            found = exact(*given, **named)
            normals = found.normals @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
            normals[:7] = 0.0
            return found._replace(normals=normals)

        monkeypatch.setattr(module, "normals", worse)
        judgement = points.noisy_planes(1e-4, device="cpu")
        np.testing.assert_allclose(judgement.errors[7:], 5.0, atol=0.01)
        assert judgement.wrong[:7].all()
        assert not judgement.wrong[7:].any()
        assert points.wide_planes(0.8, device="cpu").wrong.sum() == 7

    def test_signs_of_normals_do_not_count(self, monkeypatch):
        module = import_module("geokit.points._normals")
        exact = module.normals
        before = points.noisy_planes(0.1, device="cpu").errors
        monkeypatch.setattr(module, "normals", lambda *a, **b: exact(*a, **b)._replace(normals=-exact(*a, **b).normals))
        np.testing.assert_array_equal(points.noisy_planes(0.1, device="cpu").errors, before)

    @pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
    def test_clouds_that_stay_where_they_are(self, monkeypatch, method):
        right = points.turned_ellipsoids(1.0, method=method, device="cpu")
        assert not right.wrong.any()
        assert right.errors.max() < 1e-12
        module = import_module("geokit.points._register")
        exact = module.register
        monkeypatch.setattr(module, "register", lambda *a, **b: exact(*a, **b)._replace(transform=np.eye(4)))
        judgement = points.turned_ellipsoids(1.0, method=method, device="cpu")
        assert judgement.wrong.all()
        assert (judgement.errors > 1e-3).all()

    def test_densities(self, monkeypatch):
        module = import_module("geokit.points._density")
        exact = module.density
        monkeypatch.setattr(module, "density", lambda *a, **b: exact(*a, **b) * 1.1)
        assert points.lattice_densities(4.0, kernel="cubic_spline", device="cpu").errors.min() > 0.099


def test_rotation_is_about_its_axis_by_its_angle():
    axis = np.array([2.0, 3.0, 6.0]) / 7.0
    turn = points._rotation(axis, 0.3)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-15)
    assert np.trace(turn) == pytest.approx(1.0 + 2.0 * np.cos(0.3))
    np.testing.assert_allclose(
        points._rotation(np.array([0.0, 0.0, 1.0]), np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-15
    )
