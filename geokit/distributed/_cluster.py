"""A connection to the scheduler of a Dask cluster."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from geokit._packages import require_package
from geokit.errors import WorkerError

# Name of a cluster of this machine.
LOCAL = "local"
# How long a scheduler may take to answer, and its first worker to come [s].
PATIENCE, WORKER_PATIENCE = 5.0, 30.0


@contextmanager
def connected(address: str, jobs: int | None = None) -> Iterator[Any]:
    """Context with a ``distributed.Client`` that has at least one worker.

    Args:
        address: Of the scheduler, as in tcp://host:8786; "local" starts one here with its workers.
        jobs: Number of these workers; None for one for each core.
    Raises:
        MissingDependencyError: Dask is not installed.
        WorkerError: No scheduler answers, or it has no workers.
    """
    distributed = require_package("distributed")
    with ExitStack() as stack:
        target: Any = address
        if address == LOCAL:
            count = jobs or os.cpu_count()
            target = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=count, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
                )
            )
        try:
            client = stack.enter_context(distributed.Client(target, timeout=PATIENCE))
        except (OSError, ValueError, TimeoutError) as error:
            raise WorkerError(
                f"{address}: no Dask scheduler answers there ({error}); start one with dask scheduler, and name it as "
                "in tcp://host:8786"
            ) from error
        try:
            client.wait_for_workers(1, timeout=WORKER_PATIENCE)
        except TimeoutError as error:
            raise WorkerError(f"{address}: has no workers; start some with: dask worker {address}") from error
        yield client
