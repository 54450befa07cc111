"""Which files go where: none is lost, none is done twice, and a worker that cannot go on gets no more."""

from __future__ import annotations

import queue
import random
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

from geokit.cli._batches import schedule
from geokit.cli._batches.schedule import Workers, files_per_task, run_all
from geokit.cli._batches.worker import versions
from geokit.errors import FileAccessError, WorkerError

NAMES = [f"file{number}" for number in range(200)]
GOOD, FULL, OLD = "tcp://good", "tcp://full", "tcp://old"


class KilledWorker(Exception):
    pass


def _run(do: Any, workers: list[str], names: list[str] = NAMES, rate: float = 10.0) -> tuple[Counter[str], list[str]]:
    """Run files on pretended workers; how often each was recorded, and the notes."""
    recorded: Counter[str] = Counter()
    notes: list[str] = []
    chance = random.Random(3)
    with ThreadPoolExecutor(3) as pool:

        def submit(_: Any, sources: list[str], without: set[str]) -> Future[Any]:
            return pool.submit(do, chance.choice([worker for worker in workers if worker not in without]), sources)

        def add(records: list[dict[str, Any]]) -> None:
            recorded.update(record["input"] for record in records if record["status"] == "done")

        run_all({}, names, Workers(submit, lambda: 3, rate), add, notes.append)
    return recorded, notes


def _done(worker: str, source: str) -> dict[str, Any]:
    return {"input": source, "status": "done", "worker": worker, "seconds": 0.01}


def test_each_file_is_done_once_in_tasks_of_several() -> None:
    sizes = []

    def do(worker: str, sources: list[str]) -> list[dict[str, Any]]:
        sizes.append(len(sources))
        return [_done(worker, source) for source in sources]

    assert _run(do, [GOOD])[0] == Counter(NAMES)
    assert max(sizes) > 8
    assert sizes[-1] == 1


def test_a_worker_without_room_or_with_other_versions_gets_no_more() -> None:
    def do(worker: str, sources: list[str]) -> list[dict[str, Any]]:
        facts = {"worker": worker, "host": "h"}
        if worker == FULL:
            error = {"message": "/out: No space left"}
            return [{**facts, "input": source, "status": "no room", "error": error} for source in sources]
        if worker == OLD:
            told = {**versions(), "warp": "0.1"}
            return [{**facts, "input": s, "status": "refused", "versions": told, "sees": True} for s in sources]
        return [_done(worker, source) for source in sources]

    recorded, notes = _run(do, [GOOD, FULL, OLD])
    assert recorded == Counter(NAMES)
    assert sorted(note.split()[0] for note in notes) == [FULL, OLD]
    assert any("warp 0.1" in note and f"warp {versions()['warp']}" in note for note in notes)
    # On this machine, there is no other worker.
    with pytest.raises(FileAccessError, match="No space left"):
        _run(lambda _, sources: [{**do(FULL, [source])[0], "worker": ""} for source in sources], [FULL])
    with pytest.raises(WorkerError, match=r"h: has .*warp 0\.1.*install the same"):
        _run(lambda _, sources: [{**do(OLD, [source])[0], "worker": ""} for source in sources], [OLD])


def test_what_kills_workers_is_set_aside_and_its_companions_are_done() -> None:
    statuses = []

    def do(worker: str, sources: list[str]) -> list[dict[str, Any]]:
        if "file77" in sources:
            raise KilledWorker(sources)
        return [_done(worker, source) for source in sources]

    records: list[dict[str, Any]] = []
    with ThreadPoolExecutor(2) as pool:
        workers = Workers(lambda _, sources, __: pool.submit(do, GOOD, sources), lambda: 2, 10.0)
        run_all({}, NAMES, workers, records.extend, statuses.append)
    assert Counter(record["input"] for record in records) == Counter(NAMES)
    (aside,) = [record for record in records if record["status"] != "done"]
    assert (aside["input"], aside["status"]) == ("file77", "set aside")
    assert "file77" in aside["error"]["message"]


def test_a_cluster_that_loses_all_its_workers_is_given_up(monkeypatch) -> None:
    monkeypatch.setattr(schedule, "LONELY", 0.01)
    left = [1, 1, 0]
    with pytest.raises(WorkerError, match=r"no workers are left.*same command"):
        run_all({}, NAMES, Workers(lambda *_: Future(), lambda: left.pop() if len(left) > 1 else 0, 1.0), print, print)


def test_tasks_are_as_large_as_the_scheduler_needs() -> None:
    assert files_per_task(10**5, 1000, None, 500.0) == 1
    assert files_per_task(10**5, 1000, 0.1, 500.0) == 20
    assert files_per_task(10**5, 1000, 10.0, 500.0) == 1
    assert files_per_task(10**5, 4, 0.01, 500.0) == 50
    assert files_per_task(1000, 100, 0.001, 500.0) == 2
    assert files_per_task(10**5, 4, 0.001, float("inf")) == 1


def test_an_error_of_a_task_ends_the_batch_and_what_waits_is_canceled() -> None:
    futures: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()

    def submit(*_: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if not futures.empty():
            future.set_exception(ZeroDivisionError("of the task"))
        futures.put(future)
        return future

    with pytest.raises(ZeroDivisionError, match="of the task"):
        run_all({}, NAMES, Workers(submit, lambda: 3, 1.0), print, print)
    assert futures.get().cancelled()


def test_a_file_whose_folder_went_away_is_asked_for_again() -> None:
    asked: Counter[str] = Counter()
    kind = {"type": "FileAccessError"}

    def do(worker: str, sources: list[str]) -> list[dict[str, Any]]:
        asked.update(sources)
        lost = {"status": "lost", "worker": worker, "error": {"message": "/out: others remove", **kind}}
        return [{**lost, "input": s} if asked[s] <= LOSSES and s == NAMES[3] else _done(worker, s) for s in sources]

    LOSSES = schedule.MOVES
    assert _run(do, [GOOD]) == (Counter(NAMES), [])
    asked.clear()
    LOSSES += 1
    with pytest.raises(FileAccessError, match="others remove"):
        _run(do, [""])
    asked.clear()
    kind["type"] = "WorkerError"
    with pytest.raises(WorkerError, match="others remove"):
        _run(do, [""])
