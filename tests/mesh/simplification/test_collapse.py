"""A trial repeats what the last one did where its limit allows that, and tries anew what it could not repeat."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.simplification import collapse
from geokit.mesh.simplification.collapse import Past, collapsed
from geokit.mesh.simplification.invariants import shape_of
from geokit.mesh.surfaces.surface import Surface
from tests.mesh.simplification.test_simplify import rough

LIMIT = 0.008


def require_same(one: TriangleMesh, other: TriangleMesh) -> None:
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def lower_limits(mesh: TriangleMesh) -> np.ndarray:
    """Less of the limit in a corner of the sheet, as if the proof had failed there."""
    return np.where((mesh.vertices[mesh.faces].mean(axis=1)[:, :2] < 0.3).all(axis=1), 0.7, 1.0) * LIMIT


@pytest.fixture(params=[1 << 14, 600])
def part(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(collapse, "PART", request.param)
    return int(request.param)


def test_with_the_same_limits_all_is_repeated(part: int) -> None:
    mesh, past = rough(60, 1), Past(rough(60, 1))
    limits = np.full(mesh.face_count, LIMIT)
    found, source = collapsed(mesh, limits, 0, past=past)
    require_same(found, collapsed(mesh, limits, 0)[0])
    # Of meshes of several parts also from where the early rounds ended.
    assert bool(past.early) == (part == 600)
    for _ in range(2):
        again, same = collapsed(mesh, limits, 0, past=past)
        require_same(again, found)
        np.testing.assert_array_equal(same, source)
        past.early.clear()


@pytest.mark.parametrize("limit", [LIMIT, np.inf])
def test_what_is_fixed_later_stays(part: int, limit: float) -> None:
    mesh = rough(60, 1)
    past, some, stays = Past(mesh), mesh.face_count // 6, np.zeros(mesh.vertex_count, bool)
    first, _ = collapsed(mesh, limit, some, past=past)
    for low in (0.2, 0.6):
        stays |= (np.abs(mesh.vertices[:, :2] - low) < 0.1).all(axis=1)
        found, source = collapsed(mesh, limit, some, fixed=stays, past=past)
        assert {row.tobytes() for row in mesh.vertices[stays]} <= {row.tobytes() for row in found.vertices}
        assert shape_of(mesh).is_kept_by(shape_of(found))
        assert found.face_count <= 1.05 * first.face_count + 2 * stays.sum()
        # Nothing that was around these vertices alone has gone.
        around = stays[mesh.faces].all(axis=1)
        assert np.isin(np.flatnonzero(around), source).all()


def test_lower_limits_are_kept_where_they_are(part: int) -> None:
    mesh, past = rough(60, 1), Past(rough(60, 1))
    first, source = collapsed(mesh, np.full(mesh.face_count, LIMIT), 0, past=past)
    limits = lower_limits(mesh)
    found, left = collapsed(mesh, limits, 0, past=past)
    alone = collapsed(mesh, limits, 0)[0]
    assert found.face_count < 1.01 * alone.face_count
    assert shape_of(mesh).is_kept_by(shape_of(found))
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    assert (Surface(found, device="cpu").closest_point(middle).distance <= limits).all()
    # Elsewhere most faces are the same ones.
    faces = {int(s): first.vertices[f].tobytes() for s, f in zip(source, first.faces, strict=True)}
    far = [s for s, f in zip(left, found.faces, strict=True) if faces.get(int(s)) == found.vertices[f].tobytes()]
    assert len(far) > 0.5 * first.face_count


def test_trials_begin_where_early_rounds_ended_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collapse, "PART", 300)
    mesh, results = rough(120, 1), []
    for threads in ("1", "2"):
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        past = Past(mesh)
        collapsed(mesh, np.full(mesh.face_count, LIMIT), 0, past=past)
        assert len(past.early) > collapse.LATE
        for log, _, _ in past.rounds[: past.early[-1 - collapse.LATE][1]]:
            # What these rounds did is not looked at again.
            log[:] = -1
        before = len(past.rounds)
        results.append(collapsed(mesh, lower_limits(mesh), 0, past=past)[0])
        assert len(past.rounds) > before
    require_same(*results)


def test_trials_begin_with_the_input_where_limits_are_far_less(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collapse, "PART", 300)
    mesh, past = rough(60, 1), Past(rough(60, 1))
    collapsed(mesh, np.full(mesh.face_count, LIMIT), 0, past=past)
    assert past.early
    limits = np.where(lower_limits(mesh) < LIMIT, 0.05, 1.0) * LIMIT
    found = collapsed(mesh, limits, 0, past=past)[0]
    assert not past.early
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    assert (Surface(found, device="cpu").closest_point(middle).distance <= limits).all()
    assert shape_of(mesh).is_kept_by(shape_of(found))
