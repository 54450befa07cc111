"""Which files go to which worker, in which order: on threads of this process, or on a Dask cluster."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

from geokit.cli._batches.worker import about_here, end_processes, run_files, set_aside, unstarted, versions
from geokit.distributed._cluster import connected
from geokit.errors import FileAccessError, GeokitError, WorkerError

# Tasks that wait for each worker, so that none is idle while records are written.
AHEAD = 2
# Tasks a second that a scheduler starts without trouble: half of what was measured (docs/design/batch.md).
TASKS_PER_SECOND = 500.0
# Least work of a task of a cluster [s]: it goes to its worker and back by several processes, some milliseconds each.
TASK_SECONDS = 0.5
# The last tasks are small, so that no worker has much to do when the others have ended.
SHARE = 4
# Times that a file is asked for again: its worker has no room, no process, or other versions, or its folder went away.
MOVES = 3
# A cluster without workers is given up after twice this time [s].
LONELY = 60.0


class Workers(NamedTuple):
    """Where files are done.

    Attributes:
        submit: Starts ``run_files(batch, sources)`` on one that is not among the given addresses; a future.
        slots: How many files they can do at a time now.
        rate: Tasks a second that can be started.
    """

    submit: Callable[[dict[str, Any], list[str], set[str]], Any]
    slots: Callable[[], int]
    rate: float


@contextmanager
def local_workers(jobs: int) -> Iterator[Workers]:
    """Threads of this process, each of which has a process of its own."""
    pool = ThreadPoolExecutor(jobs, "batch")
    try:
        yield Workers(lambda batch, sources, _: pool.submit(run_files, batch, sources), lambda: jobs, float("inf"))
    except BaseException as error:
        pool.shutdown(wait=False, cancel_futures=True)
        end_processes()
        if why := unstarted(error):  # it is of the pool
            raise WorkerError(why) from error
        raise
    finally:
        pool.shutdown()


@contextmanager
def remote_workers(address: str, jobs: int | None, staging: str) -> Iterator[Workers]:
    """The workers of a Dask cluster, which are asked first what they are.

    Args:
        address: Of the scheduler, or "local" for a cluster of this machine.
        jobs: Processes of a local cluster.
        staging: A folder that they must see.
    Raises:
        MissingDependencyError: Dask is not installed.
        WorkerError: No scheduler or no worker answers, or a worker has other versions or cannot write to the folder.
    """
    with connected(address, jobs) as client:
        for worker, found in client.run(about_here, staging, on_error="return").items():
            if isinstance(found, BaseException):
                raise WorkerError(f"{worker}: geokit does not work there ({found}); install {_said(versions())} on it")
            refused = _refusal({**found, "worker": worker})
            if refused:
                raise WorkerError(refused)

        def addresses() -> dict[str, int]:
            return dict(client.nthreads())

        def submit(batch: dict[str, Any], sources: list[str], without: set[str]) -> Any:
            allowed = None
            if without:
                allowed = [worker for worker in addresses() if worker not in without]
                if not allowed:
                    raise WorkerError(f"{address}: none of its workers can go on; see the messages above")
            return client.submit(run_files, batch, sources, pure=False, workers=allowed)

        counted = [0.0, 0.0]

        def count() -> int:
            if time.monotonic() >= counted[0]:
                counted[:] = time.monotonic() + 2.0, sum(addresses().values())
            return int(counted[1])

        yield Workers(submit, count, TASKS_PER_SECOND)


def _said(found: dict[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in found.items())


def _refusal(found: dict[str, Any]) -> str:
    """Why a worker cannot take part; "" if it can."""
    where = f"{found['worker']} ({found['host']})" if found["worker"] else found["host"]
    if found["versions"] != versions():
        return (
            f"{where}: has {_said(found['versions'])}, and this batch {_said(versions())}; "
            "install the same there, or stop that worker"
        )
    told = f"{where}: cannot write to the folder of the batch; use an --out that all machines share"
    return "" if found["sees"] else told


def files_per_task(left: int, workers: int, seconds: float | None, rate: float) -> int:
    """How many files a task has: so many that the scheduler keeps up, and fewer towards the end.

    Args:
        left: Files that are not given out.
        workers: How many there are.
        seconds: Mean time of a file; None while it is not known.
        rate: Tasks a second that the scheduler starts.
    """
    if not seconds or rate == float("inf"):
        return 1
    wanted = -(-max(workers / rate, TASK_SECONDS) // seconds)
    return int(max(1, min(wanted, left // (SHARE * workers))))


def run_all(
    batch: dict[str, Any],
    sources: Sequence[str],
    workers: Workers,
    add: Callable[[list[dict[str, Any]]], None],
    note: Callable[[str], None],
) -> None:
    """Have all files done, and hand their records to ``add``, several at a time.

    Raises:
        FileAccessError: There is no room on the disk.
        WorkerError: The cluster went away, or none of its workers can go on.
    """
    todo, ended = deque([source] for source in sources), queue.SimpleQueue[Any]()
    flying: dict[Any, list[str]] = {}
    without: set[str] = set()
    moves: dict[str, int] = {}
    seconds: float | None = None
    try:
        while todo or flying:
            count = max(1, workers.slots())
            while todo and len(flying) < AHEAD * count:
                group = list(todo.popleft())
                size = files_per_task(len(todo), count, seconds, workers.rate)
                while todo and len(group) < size and len(todo[0]) == 1:
                    group += todo.popleft()
                future = workers.submit(batch, group, without)
                flying[future] = group
                future.add_done_callback(ended.put)
            futures = [_next(ended, workers)]
            while not ended.empty():
                futures.append(ended.get())
            good, problem = [], None
            for future in futures:
                group = flying.pop(future)
                for record in _records(future, group, todo):
                    if record["status"] in ("no room", "refused", "lost"):
                        problem = _moved(record, moves, without, note) or problem
                        todo.append([record["input"]])
                    else:
                        good.append(record)
                        if "seconds" in record:
                            seconds = 0.9 * seconds + 0.1 * record["seconds"] if seconds else record["seconds"]
            add(good)
            if problem:
                raise problem
    finally:
        for future in flying:
            future.cancel()


def _next(ended: queue.SimpleQueue[Any], workers: Workers) -> Any:
    """The next task that has ended."""
    lonely = 0
    while True:
        try:
            return ended.get(timeout=LONELY)
        except queue.Empty:
            lonely = 0 if workers.slots() else lonely + 1
        if lonely > 1:
            raise WorkerError("no workers are left; start some, and run the same command again: it goes on from here")


def _records(future: Any, group: list[str], todo: deque[list[str]]) -> list[dict[str, Any]]:
    try:
        return list(future.result())
    except GeokitError:
        raise
    except CancelledError as error:
        raise WorkerError("the scheduler went away; run the same command again, it goes on from here") from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            if len(group) == 1:
                return [set_aside(group[0], "killed the machines or processes of several workers")]
            todo.extend([source] for source in group)
            return []
        if type(error).__module__.startswith(("distributed", "dask")):
            raise WorkerError(
                f"the cluster failed ({error}); run the same command again, it goes on from here"
            ) from error
        raise


def _moved(
    record: dict[str, Any], moves: dict[str, int], without: set[str], note: Callable[[str], None]
) -> GeokitError | None:
    """Take a worker out that cannot do any file, but not for a file that is lost; the error if that ends the batch."""
    refused = record["status"] == "refused"
    message = _refusal(record) if refused else record["error"]["message"]
    moves[record["input"]] = moves.get(record["input"], 0) + 1
    lost = record["status"] == "lost"
    if moves[record["input"]] > MOVES or not (record["worker"] or lost):
        is_worker = refused or record["error"].get("type") == "WorkerError"
        return WorkerError(message) if is_worker else FileAccessError(message)
    if not lost and record["worker"] not in without:
        without.add(record["worker"])
        note(f"{record['worker']} gets no more files: {message}")
    return None
