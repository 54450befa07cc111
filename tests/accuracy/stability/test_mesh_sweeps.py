"""The sweeps of mesh methods: their shapes are what they say, their judges see what is wrong, their promises have room.

That the envelopes hold, and end where they say, is asserted in tests/accuracy/stability/test_envelopes.py.
"""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest

from geokit import mesh
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.stability import shapes
from geokit.accuracy.stability.follow_sweeps import inside, promised, sweeps_of
from geokit.accuracy.stability.shapes import around_and_near, judged, powers, turned
from geokit.mesh.surfaces.surface import Surface
from tests.support.reference import box_distance

SWEEPS = sweeps_of("mesh", "cpu")
# Factor by which values of other seeds may exceed those of the tested ones.
ROOM = 4.0
# The promise of these is set by the caller or by the question: no margin is needed.
EXACT = {"hausdorff_tolerance", "merge_vertices_tolerance"}


def by_name(sweeps):
    return [pytest.param(sweep, id=sweep.name) for sweep in sweeps]


def test_sweeps_are_well_formed():
    names = [sweep.name for sweep in SWEEPS]
    assert len(set(names)) == len(names)
    for sweep in SWEEPS:
        steps = np.diff(sweep.values)
        assert (steps > 0).all() or (steps < 0).all(), sweep.name
        assert sweep.envelope.last in sweep.values
        assert (sweep.envelope.last == sweep.values[-1]) == ("no failure found" in sweep.envelope.statement), sweep.name
        assert not sweep.logarithmic or min(sweep.values) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("sweep", by_name(SWEEPS))
def test_promises_have_room_on_another_seed(sweep):
    last = sweep.envelope.last
    judgement = sweep.ask(last, seed=1)
    assert len(judgement.errors) == len(judgement.wrong) > 0
    assert judgement.positions is None or judgement.positions.shape == (len(judgement.wrong), 3)
    assert ROOM * judgement.wrong.mean() <= sweep.envelope.wrong_share
    room = 1.0 if sweep.name in EXACT else ROOM
    assert room * judgement.errors[~judgement.wrong].max() <= promised(sweep, last)
    same = sweep.ask(last, seed=1)
    np.testing.assert_array_equal(same.errors, judgement.errors)
    np.testing.assert_array_equal(same.wrong, judgement.wrong)


def worse_closest(found):
    return found._replace(distance=found.distance * (1.0 + 1e-5), points=found.points * (1.0 + 1e-5) + 1e-5)


def worse_hits(found):
    return found._replace(t=np.where(np.arange(len(found.t)) % 50 == 7, 0.0, found.t))


# Ways to corrupt the answers of a method.
WORSE = {
    "mesh.Surface.closest_point": (Surface, "closest_point", worse_closest),
    "mesh.Surface.signed_distance": (Surface, "signed_distance", lambda f: f._replace(distance=-f.distance)),
    "mesh.Surface.contains": (Surface, "contains", np.logical_not),
    "mesh.Surface.raycast": (Surface, "raycast", worse_hits),
    "mesh.Surface.crossing_count": (Surface, "crossing_count", lambda f: f + (np.arange(len(f)) == 7)),
    "mesh.hausdorff": ("geokit.mesh._hausdorff", "hausdorff", lambda f: f._replace(max=f.max - 1.0)),
    "mesh.orient": (
        "geokit.mesh._repair",
        "orient",
        lambda f: f._replace(mesh=shapes.flipped_faces(f.mesh, 1.0)),
    ),
    "mesh.audit": ("geokit.mesh._audit", "audit", lambda f: dataclasses.replace(f, area=1.01 * f.area)),
    "mesh.merge_vertices": ("geokit.mesh._repair", "merge_vertices", lambda f: shapes.moved(f, (1e-2, 0.0, 0.0))),
}


@pytest.mark.parametrize("sweep", by_name(SWEEPS))
def test_a_method_made_worse_is_noticed(sweep, monkeypatch):
    where, name, spoil = WORSE[sweep.method.split("(")[0]]
    if isinstance(where, str):
        where = importlib.import_module(where)
    honest = getattr(where, name)
    monkeypatch.setattr(where, name, lambda *given, **named: spoil(honest(*given, **named)))
    judgement = sweep.ask(sweep.values[0])
    error = judgement.errors[~judgement.wrong].max(initial=0.0)
    assert error > promised(sweep, sweep.values[0]) or judgement.wrong.mean() > sweep.envelope.wrong_share


def test_envelopes_do_not_cover_what_fails():
    for sweep in SWEEPS:
        beyond = [value for value in sweep.values if not inside(sweep, value)]
        assert bool(beyond) == ("no failure found" not in sweep.envelope.statement)


def test_judged_takes_no_number_for_infinitely_wrong():
    judgement = judged([np.nan, -2.0, np.nan, np.inf], [False, False, True, False])
    np.testing.assert_array_equal(judgement.errors, [np.inf, 2.0, 0.0, np.inf])
    np.testing.assert_array_equal(judgement.wrong, [False, False, True, False])


def test_powers_are_the_nearest_numbers():
    assert powers(0, -23, -1)[-1] == 1e-23
    assert powers(2, 0, -2) == (100.0, 1.0)


CLOSED = [
    shapes.box(),
    shapes.thin_plate(0.01),
    shapes.icosphere(2),
    shapes.torus(),
    shapes.rotated(shapes.box(), 3),
]


@pytest.mark.parametrize("shape", CLOSED, ids=["box", "plate", "sphere", "torus", "turned"])
def test_closed_shapes_are_clean(shape):
    report = mesh.audit(shape, self_intersections=True)
    assert report.watertight
    assert report.oriented
    assert report.manifold
    assert not report.inside_out
    assert report.degenerate_count == report.duplicate_count == report.self_intersection_count == 0


def test_sizes_of_shapes():
    assert mesh.audit(shapes.box((0, 0, 0), (1, 2, 3))).signed_volume == pytest.approx(6.0, rel=1e-14)
    assert mesh.audit(shapes.thin_plate(1e-3)).signed_volume == pytest.approx(1e-3, rel=1e-12)
    assert mesh.audit(shapes.icosphere(4, 2.0)).signed_volume == pytest.approx(4 / 3 * np.pi * 8, rel=5e-3)
    assert mesh.audit(shapes.torus(96, 48)).signed_volume == pytest.approx(2 * np.pi**2 * 0.35**2, rel=1e-2)
    assert mesh.audit(shapes.sliver_fan(5, 1e4, 0.3)).area == pytest.approx(0.5 * 5e-4, rel=1e-9)
    np.testing.assert_allclose(shapes.sphere_distance(shapes.icosphere(3, 2.0).vertices, 2.0), 0.0, atol=1e-15)
    x, y, z = shapes.torus().vertices.T
    np.testing.assert_allclose(np.hypot(np.hypot(x, y) - 1.0, z), 0.35, atol=1e-15)


def test_distance_to_a_box_is_that_of_its_triangles():
    lower, upper = np.array([-1.0, 0.0, 0.5]), np.array([1.0, 0.25, 2.0])
    shape = shapes.box(tuple(lower), tuple(upper))
    points = around_and_near(shape, 400, 5)
    expected = reference.signed_distance(shape.vertices, shape.faces, points)
    np.testing.assert_allclose(box_distance(points, lower, upper), expected, atol=1e-14)


def test_rotations_turn_meshes_and_points_alike():
    turn = shapes.rotation(4)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    shape = shapes.torus(8, 5)
    np.testing.assert_array_equal(shapes.rotated(shape, 4).vertices, turned(shape.vertices, 4))


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5])
def test_shares_are_shares(share):
    sphere = shapes.icosphere(3)
    area = mesh.audit(sphere).area
    for open_mesh in (shapes.without_cap(sphere, share), shapes.without_faces(sphere, share, 2)):
        # One face more or less.
        assert 1.0 - mesh.audit(open_mesh).area / area == pytest.approx(share, abs=2.0 / len(sphere.faces))
    flipped = shapes.flipped_faces(sphere, share, 2)
    changed = (flipped.faces != sphere.faces).any(axis=1)
    assert changed.sum() == round(share * len(sphere.faces))
    np.testing.assert_array_equal(flipped.faces[changed], sphere.faces[changed][:, ::-1])
    assert mesh.audit(shapes.copied_faces(sphere, share, 2)).duplicate_count == changed.sum()


def test_slivers_begin_at_each_of_their_corners():
    fan = shapes.sliver_fan(6, 1e3)
    assert sorted(np.nonzero(fan.faces == 0)[1].tolist()) == [0, 0, 1, 1, 2, 2]
    assert mesh.audit(fan).aspect_ratio_quantiles[0] > 300.0
