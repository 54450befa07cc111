"""What a forked child makes anew: locks that a thread of the parent may have held, and thread pools.

``multiprocessing`` forks by default before Python 3.14, and PyTorch's ``DataLoader`` does on Linux.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Protocol
from weakref import WeakSet

# Where the system has no forks, nothing is to be done at one.
register_at_fork: Callable[..., None] = getattr(os, "register_at_fork", lambda **_: None)


class ForkAware(Protocol):
    """An object that holds locks or threads."""

    def _after_fork(self) -> None:
        """Make the locks and thread pools anew; called in a forked child, which has one thread."""


_owners: WeakSet[ForkAware] = WeakSet()


def renew_after_fork(owner: ForkAware) -> None:
    """Call ``owner._after_fork()`` in every forked child, as long as the owner lives."""
    _owners.add(owner)


class Lock:
    """A reentrant lock that a forked child has anew."""

    def __init__(self) -> None:
        self._after_fork()
        renew_after_fork(self)

    def _after_fork(self) -> None:
        self._lock = threading.RLock()

    # Methods of the lock itself: after one of Python that had taken it, an interrupt would leave it taken.
    @property
    def __enter__(self) -> Callable[[], bool]:
        return self._lock.__enter__

    @property
    def __exit__(self) -> Callable[..., None]:
        return self._lock.__exit__


def _renew_all() -> None:
    for owner in _owners:
        owner._after_fork()


register_at_fork(after_in_child=_renew_all)
