"""Runs every operation on every lying grid in processes of their own: ``python -m tests.support.lying_runs SOURCE``.

Prints a JSON list for each case that is neither answered nor refused by name within the limits, then the counts.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable
from typing import Any

from geokit.errors import GeokitError
from geokit.volume.model.sparse_volume import SparseVolume
from tests.support.effort import of_all, spread
from tests.support.forked import forked
from tests.support.lying_grids import LIES, OPERATIONS, SOURCES, lying

__all__ = ["TRIED", "operations_on", "run_all"]

CPU_SECONDS = 8
TRIED = spread(LIES, 20)
# A sound grid of these sizes takes some tens of megabytes.
MEMORY_BYTES = 1 << 30
# A backstop for waiting processes, which take no CPU time.
WALL_SECONDS = 120


def operations_on(number: int) -> dict[str, Any]:
    """The operations tried on the lie of this number: by default one half, and the other half on the next lie."""
    step = of_all(2, 1)
    return dict([*OPERATIONS.items()][number % step :: step])


def run_all(source: str) -> Counter[str]:
    """Print the bad cases of one of SOURCES, and count "answered", "refused" and "bad"."""
    counts: Counter[str] = Counter()
    sound = SOURCES[source]()
    with tempfile.TemporaryDirectory() as folder:
        for operation in OPERATIONS.values():
            _outcome(operation, sound, folder)  # loads the kernels that the forked processes share
        for number, lie in enumerate(TRIED):
            volume, tried = lying(sound, lie), operations_on(number)
            # All within the limits of one, or a process for each.
            results = _apart(tried.values(), volume, folder)
            if any(kind == "bad" for kind, _ in results):
                results = [_apart([operation], volume, folder)[0] for operation in tried.values()]
            for name, (kind, detail) in zip(tried, results, strict=True):
                counts[kind] += 1
                if kind == "bad":
                    print(json.dumps([source, lie, name, detail]), flush=True)
    return counts


def _outcome(operation: Any, volume: SparseVolume, folder: str) -> tuple[str, str]:
    try:
        operation(volume, folder)
    except GeokitError:
        return "refused", ""
    except Exception as error:
        return "bad", repr(error)[:300]
    return "answered", ""


def _apart(operations: Iterable[Any], volume: SparseVolume, folder: str) -> list[tuple[str, str]]:
    """Outcomes of operations in a forked process, or a bad one if it ends or exceeds a limit."""

    def work() -> list[tuple[str, str]]:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        results = [_outcome(operation, volume, folder) for operation in operations]
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before << 10
        return [("bad", f"{grown >> 20} MiB")] if grown > MEMORY_BYTES else results

    found, code = forked(work, WALL_SECONDS)
    return found or [("bad", f"ended by signal {-code}")]


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(run_all(sys.argv[1])))
