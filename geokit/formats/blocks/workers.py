"""Parts of the work on a large file, on other processes or machines."""

from __future__ import annotations

import queue
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from geokit.errors import GeokitError, InputError, WorkerError

__all__ = ["TASK_MEMORY", "Workers", "require_executor", "require_seen"]

# Memory of a task where none is given: how many run on a machine is not known.
TASK_MEMORY = 1 << 30


def require_executor(executor: Any) -> None:
    """Check that an executor can be given tasks.

    Raises:
        InputError: It has no ``submit``.
    """
    if not callable(getattr(executor, "submit", None)):
        raise InputError(
            f"executor: a {type(executor).__name__} has no submit; give an executor of concurrent.futures or a Dask "
            "Client"
        )


def require_seen(path: Path, folder: Path) -> None:
    """Check, on a worker, that a file of the work is there.

    Raises:
        WorkerError: It is not: ``folder`` is that of another machine.
    """
    if not path.exists():
        raise WorkerError(
            f"{folder}: a worker does not see the files of its task there; give an out in a folder that all workers "
            "share"
        )


class Workers:
    """Tasks on an executor's workers. As a context: at its end nothing runs any more.

    Executors have ``submit(function, *arguments)``, and their futures ``result()``, ``cancel()`` and
    ``add_done_callback``: those of concurrent.futures, of mpi4py, and Dask's Client.

    Args:
        executor: Where tasks run.
        folder: Where the files of the work are, for messages.
    """

    def __init__(self, executor: Any, folder: Path) -> None:
        self._executor, self._folder = executor, folder
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._running: dict[Any, Any] = {}

    def __enter__(self) -> Workers:
        return self

    def submit(self, task: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Let a worker call a function; ``task`` comes back with the result."""
        with self._named():
            future = self._executor.submit(function, *arguments)
        self._running[future] = task
        future.add_done_callback(self._done.put)

    def results(self) -> Generator[tuple[Any, Any], None, None]:
        """Tasks and results in the order in which they are done, until no task is left.

        Raises:
            WorkerError: A worker was lost.
            GeokitError: What a task raised.
        """
        while self._running:
            future = self._done.get()
            task = self._running.pop(future)
            with self._named():
                result = future.result()
            yield task, result

    def __exit__(self, *_: object) -> None:
        # Files of tasks go away next: what still runs is waited for.
        left = {future for future in self._running if future.cancel() is False}
        while left:
            left.discard(self._done.get())

    @contextmanager
    def _named(self) -> Generator[None, None, None]:
        try:
            yield
        except GeokitError:
            raise
        except Exception as error:
            raise WorkerError(
                f"executor: a task of {self._folder} was not done ({type(error).__name__}: {error}); see the workers' "
                "memory and logs"
            ) from error
