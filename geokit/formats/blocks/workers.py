"""Parts of the work on a large file, here, on other processes or on other machines."""

from __future__ import annotations

import functools
import pickle
import queue
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from geokit.core.content_limit import working_memory
from geokit.errors import GeokitError, InputError, WorkerError
from geokit.formats.blocks.records import RecordFile

# Memory of a task where none is given: how many run on a machine is not known.
TASK_MEMORY = 1 << 30


def task_memory(executor: Any, memory_limit: int | None) -> int:
    """Bytes that work on files may take that goes part by part, here or in each task of an executor.

    Raises:
        InputError: The executor has no ``submit``, or memory_limit is out of range.
    """
    if executor is None:
        return working_memory(memory_limit)
    if not callable(getattr(executor, "submit", None)):
        raise InputError(
            f"executor: a {type(executor).__name__} has no submit; give an executor of concurrent.futures or a Dask "
            "Client"
        )
    return working_memory(TASK_MEMORY if memory_limit is None else memory_limit)


class Done(NamedTuple):
    """What came of a task.

    Attributes:
        found: An array, if there is one.
        tasks: Tasks into which it was split.
        number: A number that adds up over all tasks.
    """

    found: Any
    tasks: Sequence[Any] = ()
    number: int = 0


class Work(Protocol):
    """What is the same for all tasks; it can be pickled."""

    def make(self, task: Any, folder: Path, /) -> Done:
        """Do a task, with files in a folder."""
        ...


def in_turn(
    work: Work, tasks: Sequence[Any], folder: Path, executor: Any, size: Callable[[Any], float] = lambda _: 0.0
) -> Generator[tuple[Any, Done], None, None]:
    """Do tasks here, one after the other, or on the workers of an executor, in the order in which they are done.

    Args:
        work: What does a task.
        tasks: The first tasks; those into which one is split follow.
        folder: Where files of the tasks are, and arrays that workers find.
        executor: Where tasks run; None for here. It has ``submit(function, *arguments)``, and its futures ``result()``,
            ``cancel()`` and ``add_done_callback``, as those of concurrent.futures, of mpi4py, and Dask's Client.
        size: Size of a task. Workers get the largest first: nobody waits for it at the end.
    Raises:
        WorkerError: A worker was lost, or does not see the folder.
        GeokitError: What a task raised.
    """
    if executor is None:
        waiting = list(tasks[::-1])
        while waiting:
            task = waiting.pop()
            done = work.make(task, folder)
            # These are next, so that few files wait.
            waiting += done.tasks[::-1]
            yield task, done
        return
    # Once for all tasks: it may be too much to send with each.
    saved = folder / "work"
    saved.write_bytes(pickle.dumps(work, protocol=5))
    ready: queue.SimpleQueue[Any] = queue.SimpleQueue()
    running: dict[Any, Any] = {}

    def submit(more: Sequence[Any]) -> None:
        for task in sorted(more, key=size, reverse=True):
            with _named(folder.parent):
                future = executor.submit(_on_worker, saved, task)
            running[future] = task
            future.add_done_callback(ready.put)

    try:
        submit(tasks)
        while running:
            future = ready.get()
            task = running.pop(future)
            with _named(folder.parent):
                done = future.result()
            submit(done.tasks)
            yield task, done if done.found is None else done._replace(found=done.found.take())
    finally:
        # Files of tasks go away next: what still runs is waited for.
        left = {future for future in running if future.cancel() is False}
        while left:
            left.discard(ready.get())


@contextmanager
def _named(folder: Path) -> Generator[None, None, None]:
    try:
        yield
    except GeokitError:
        raise
    except Exception as error:
        raise WorkerError(
            f"executor: a task of {folder} was not done ({type(error).__name__}: {error}); see the workers' memory and "
            "logs"
        ) from error


# The folder is new for each call, and so is the file's name.
@functools.lru_cache(maxsize=1)
def _loaded(saved: Path) -> Work:
    work: Work = pickle.loads(saved.read_bytes())
    return work


def _on_worker(saved: Path, task: Any) -> Done:
    """Do a task in another process: the array goes into a file of the folder, which both must see.

    Raises:
        WorkerError: The folder is not there: it is that of another machine.
    """
    folder = saved.parent
    if not saved.exists():
        raise WorkerError(
            f"{folder.parent}: a worker does not see the files of its task there; give an out in a folder that all "
            "workers share"
        )
    done = _loaded(saved).make(task, folder)
    if done.found is None:
        return done
    handle, name = tempfile.mkstemp(dir=folder)
    with open(handle, "wb") as file:
        file.write(done.found.data)
    return done._replace(found=RecordFile(Path(name), done.found.dtype, len(done.found)))
