"""A cluster of dask in processes of this machine."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

__all__ = ["cluster_client"]

# LocalCluster(dashboard_address=None) shows no dashboard, and yet its scheduler takes port 8787 if it is free, and
# warns if it is not: of two tests at a time, one would fail.
SCHEDULER = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}


@contextlib.contextmanager
def cluster_client(workers: int = 2) -> Iterator[Any]:
    """A client, the default one meanwhile, of workers with one thread each."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=workers, threads_per_worker=1, scheduler_kwargs=SCHEDULER) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client
