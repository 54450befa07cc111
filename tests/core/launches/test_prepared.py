"""Replays: when they are made, what ends them, and what they check."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import threading
import weakref

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.launches import prepared
from geokit.core.query import ask
from geokit.errors import InputError
from tests.support.devices import DEVICES


@pytest.fixture
def surface():
    return gk.mesh.Surface(mesh_catalog.icosphere(), device="cpu")


@pytest.fixture
def replays(monkeypatch):
    """Counts the replays that answer."""
    made = []
    run = prepared.Recording.replay

    def counted(self, given):
        answer = run(self, given)
        made.append(answer is not None)
        return answer

    monkeypatch.setattr(prepared.Recording, "replay", counted)
    return made


def point(*xyz):
    return np.array([xyz], np.float64)


def kept(asked):
    return asked._cache.find(prepared.KEPT, dict)


def test_the_third_call_is_a_replay(surface, replays):
    for k in range(4):
        assert surface.closest_point(point(0, 0, 2 + k)).distance == pytest.approx(1 + k)
    assert replays == [True, True]


@pytest.mark.parametrize("device", DEVICES)
def test_on_every_device_later_calls_answer_as_the_first(device):
    surface = gk.mesh.Surface(mesh_catalog.icosphere(), device=device)
    rows = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 5, 3))
    for query in ("closest_point", "signed_distance", "contains", "winding_number", "furthest_point"):
        expected = [getattr(gk.mesh.Surface, query).__wrapped__(surface, some) for some in rows]
        for some, right in zip(rows, expected, strict=True):
            found = getattr(surface, query)(some)
            pairs = zip(found, right, strict=True) if isinstance(found, tuple) else [(found, right)]
            for one, other in pairs:
                np.testing.assert_array_equal(one, other)


def test_one_point_is_replayed_too(surface, replays):
    for values in (point(0, 0, 3), point(0, 0, 3).astype(np.float32)):
        row = surface.closest_point(values)
        for _ in range(4):
            alone = surface.closest_point(values[0])
            for many, one in zip(row, alone, strict=True):
                assert (one.shape, one.dtype) == (many.shape[1:], many.dtype)
                np.testing.assert_array_equal(one, many[0])
    assert replays == [True, True] * 2


def test_arguments_and_earlier_answers_are_left_alone(surface):
    given = [point(0, 0, 2 + k) for k in range(5)]
    answers = [surface.closest_point(values) for values in given]
    assert [float(answer.distance[0]) for answer in answers] == pytest.approx([1, 2, 3, 4, 5])
    assert [values.tolist() for values in given] == [[[0, 0, 2 + k]] for k in range(5)]
    answers[-1].points[:] = 7.0
    np.testing.assert_allclose(surface.closest_point(given[0]).points, [[0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_rows_that_are_not_finite_are_refused_by_name(surface, bad):
    volume = gk.volume.from_mesh(surface, 0.2)
    grid = gk.points.NeighborGrid(surface.mesh.vertices, 0.3, device="cpu")
    for query in (
        surface.closest_point,
        surface.signed_distance,
        surface.furthest_point,
        lambda rows: surface.raycast(rows, rows),
        lambda rows: volume.sample(rows, device="cpu"),
        lambda rows: volume.raycast(rows, rows, device="cpu"),
        grid.count,
        grid.knn,
    ):
        good = np.array([[1.0, 0.5, 0.25], [0.5, 0.5, 0.5]])
        expected = [query(good) for _ in range(4)][-1]
        wrong = good.copy()
        wrong[1, 2] = bad
        for _ in range(2):
            with pytest.raises(InputError, match="row 1 "):
                query(wrong)
        again = query(good)
        for one, other in zip(np.atleast_2d(*again), np.atleast_2d(*expected), strict=True):
            np.testing.assert_array_equal(one, other)


def test_huge_rows_are_not_taken_for_infinite_ones(surface):
    grid = gk.points.NeighborGrid(surface.mesh.vertices, 0.3, device="cpu")
    for _ in range(4):
        assert grid.count(np.full((1, 3), 1.7e308)).tolist() == [0]


def test_options_are_checked_at_every_call(surface):
    grid = gk.points.NeighborGrid(surface.mesh.vertices, 0.3, device="cpu")
    volume = gk.volume.from_mesh(surface, 0.2)
    for _ in range(4):
        grid.knn(point(0, 0, 0), 1)
        volume.sample(point(0, 0, 0), order=1, device="cpu")
        surface.closest_point(point(0, 0, 0), max_distance=1.0)
        surface.raycast(point(0, 0, 0), point(0, 0, 1))
    for wrong in (True, 1.0, "1", 0, None):
        with pytest.raises(InputError, match="k: "):
            grid.knn(point(0, 0, 0), wrong)
    for wrong in (True, 1.0, 4):
        with pytest.raises(InputError, match="order: "):
            volume.sample(point(0, 0, 0), order=wrong, device="cpu")
    for wrong in (math.nan, -1.0, "1.0", True):
        with pytest.raises(InputError, match="max_distance: "):
            surface.closest_point(point(0, 0, 0), max_distance=wrong)
    with pytest.raises(InputError, match="directions: "):
        surface.raycast(point(0, 0, 0), np.ones((2, 3)))
    with pytest.raises(InputError, match="directions: row 0 is zero"):
        surface.raycast(point(0, 0, 0), point(0, 0, 0))
    with pytest.raises(TypeError):
        surface.closest_point(point(0, 0, 0), reach=1.0)
    with pytest.raises(InputError, match="points: "):
        surface.closest_point(np.ones((1, 4)))


def test_rows_may_be_given_by_name(surface):
    volume = gk.volume.from_mesh(surface, 0.2)
    for k in range(4):
        where = point(0, 0, 0.8 + 0.1 * k)
        assert surface.closest_point(points=where).distance == surface.closest_point(where).distance
        expected = volume.sample(where, device="cpu")
        assert gk.volume.sample(volume=volume, points=where, device="cpu") == expected
        assert gk.volume.sample(volume, points=where, device="cpu") == expected


def test_progress_is_reported_at_every_call(surface):
    seen = []
    for _ in range(4):
        surface.closest_point(point(0, 0, 2), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 1)] * 4


def test_an_update_ends_the_recordings(surface):
    for _ in range(4):
        surface.closest_point(point(0, 0, 3))
    assert kept(surface)
    surface.update(2.0 * surface.mesh.vertices)
    assert not kept(surface)
    for _ in range(4):
        assert surface.closest_point(point(0, 0, 3)).distance == pytest.approx(1.0)


def test_cells_for_another_radius_end_the_recordings():
    grid = gk.points.NeighborGrid(np.random.default_rng(0).random((500, 3)), 0.1, device="cpu")
    for radius in (0.1, 0.5, 0.1, 0.9, 0.5):
        for _ in range(4):
            expected = grid.count.__wrapped__(grid, point(0.5, 0.5, 0.5), radius=radius)
            assert grid.count(point(0.5, 0.5, 0.5), radius=radius) == expected


def test_copies_have_recordings_of_their_own(surface):
    volume = gk.volume.from_mesh(surface, 0.2)
    for _ in range(4):
        surface.closest_point(point(0, 0, 3))
        volume.sample(point(0, 0, 1), device="cpu")
    for asked in (surface, volume):
        for other in (pickle.loads(pickle.dumps(asked)), copy.copy(asked), copy.deepcopy(asked)):
            assert not kept(other)


@pytest.mark.slow
def test_recordings_end_with_their_object():
    surface = gk.mesh.Surface(mesh_catalog.icosphere(), device="cpu")
    for _ in range(4):
        surface.closest_point(point(0, 0, 3))
    gone, corners = weakref.ref(surface), weakref.ref(surface._tree.corners)
    del surface
    gc.collect()
    assert gone() is None
    assert corners() is None


def test_calls_that_always_differ_keep_little(surface):
    for k in range(5 * prepared.MOST_KEPT):
        surface.closest_point(point(0, 0, 3), max_distance=1.0 + k)
    assert len(kept(surface)) <= prepared.MOST_KEPT


def test_what_is_built_for_later_calls_is_not_part_of_a_replay():
    volume = gk.volume.from_mesh(gk.mesh.Surface(mesh_catalog.icosphere(), device="cpu"), 0.1)
    rows = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    expected = volume.sample(rows, device="cpu")
    key = "leaf table cpu"
    # The call that builds the table is one that is recorded, for one of these numbers of rows.
    for count in range(1, 200):
        for _ in range(2):
            np.testing.assert_array_equal(volume.sample(rows[:count], order=1, device="cpu"), expected[:count])
    assert key in volume._uploads
    np.testing.assert_array_equal(volume.sample(rows, device="cpu"), expected)


def test_threads_have_recordings_of_their_own(surface):
    rows = np.random.default_rng(0).uniform(-2, 2, (64, 1, 3))
    expected = surface.signed_distance(rows[:, 0]).distance
    wrong = []

    def work(seed):
        for k in np.random.default_rng(seed).integers(0, 64, 400):
            if surface.signed_distance(rows[k]).distance[0] != expected[k]:
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize("refused", [False, True])
def test_a_recorded_call_has_its_own_answer_whatever_another_thread_asks_meanwhile(surface, monkeypatch, refused):
    surface.closest_point(point(0, 0, 3))
    answer = prepared.Recording.answer

    def work():
        if refused:
            monkeypatch.setattr(prepared.Recording, "finish", lambda *_: False)
        surface.closest_point(point(0, 0, 9))

    def late(recording):
        monkeypatch.setattr(prepared.Recording, "answer", answer)
        other = threading.Thread(target=work)
        other.start()
        other.join()
        return answer(recording)

    monkeypatch.setattr(prepared.Recording, "answer", late)
    assert np.isclose(surface.closest_point(point(0, 0, 3)).distance[0], 2.0)


@pytest.mark.slow
def test_an_update_meanwhile_leaves_one_of_both_states(surface):
    near, far = surface.mesh.vertices, 2.0 * surface.mesh.vertices
    stop, wrong = threading.Event(), []

    def work():
        while not stop.is_set():
            found = surface.closest_point(point(0, 0, 4))
            if not (np.isclose(found.distance[0], 3.0) or np.isclose(found.distance[0], 2.0)):
                wrong.append(found)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for k in range(40):
        surface.update(far if k % 2 else near)
    stop.set()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_replays(surface):
    for _ in range(4):
        surface.closest_point(point(0, 0, 3))
    child = os.fork()
    if not child:
        right = all(np.isclose(surface.closest_point(point(0, 0, 3 + k)).distance[0], 2 + k) for k in range(4))
        os._exit(0 if right else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_query_that_depends_on_its_rows_between_launches_is_not_replayed(replays):
    class Asked:
        _cache = CacheAttribute()

    @ask.query("rows", is_replayed=True)
    def total(asked, rows):
        prepared.refuse()
        return rows.sum(axis=1)

    asked = Asked()
    for k in range(5):
        assert total(asked, point(k, 1, 1)).tolist() == [k + 2]
    assert not replays


def test_what_is_not_queried_is_refused_as_ever():
    for wrong in (None, 3, "volume", object(), gk.mesh.Surface):
        for _ in range(3):
            with pytest.raises(InputError):
                gk.volume.sample(wrong, point(0, 0, 0), device="cpu")


@pytest.mark.parametrize("shape", [(5, 3), (3,)])
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_tensors_of_torch_on_the_host(surface, replays, shape, kind) -> None:
    torch = pytest.importorskip("torch")
    points = np.random.default_rng(1).random(shape).astype(kind)
    tensor = torch.from_numpy(points)
    expected = surface.closest_point(points), surface.raycast(points, 1.0 - points)
    for _ in range(4):
        found = surface.closest_point(tensor), surface.raycast(tensor, 1.0 - points)
    assert replays[-2:] == [True, True]
    for answer, same in zip(found, expected, strict=True):
        assert type(answer) is type(same)
        for part, other in zip(answer, same, strict=True):
            assert type(part) is torch.Tensor
            assert part.numpy().dtype == other.dtype
            assert np.array_equal(part.numpy(), other, equal_nan=True)
    kept = found[0].points.clone()
    surface.closest_point(tensor + 1.0)
    assert torch.equal(found[0].points, kept)  # an answer is the caller's own


def test_other_tensors_go_the_general_way(surface, replays) -> None:
    torch = pytest.importorskip("torch")
    for tensor in (torch.zeros(2, 3, dtype=torch.int64), torch.zeros(2, 3, dtype=torch.bfloat16)):
        for _ in range(3):
            assert surface.closest_point(tensor).points.dtype == torch.float64
    assert not replays
