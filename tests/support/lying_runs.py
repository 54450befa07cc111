"""Runs every operation on every lying grid, each in its own process: ``python -m tests.support.lying_runs SOURCE``.

Prints a JSON list for each case that is neither answered nor refused by name within the limits, then the counts.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import warnings
from collections import Counter
from typing import Any

from geokit.errors import GeokitError
from geokit.volume._model import SparseVolume
from tests.support.forked import forked
from tests.support.lying_grids import LIES, OPERATIONS, SOURCES, lying

__all__ = ["run_all"]

CPU_SECONDS = 8
# A sound grid of these sizes takes some tens of megabytes.
MEMORY_BYTES = 1 << 30
# A backstop for waiting processes, which take no CPU time.
WALL_SECONDS = 120


def run_all(source: str) -> Counter[str]:
    """Print the bad cases of one of SOURCES, and count "answered", "refused" and "bad"."""
    counts: Counter[str] = Counter()
    sound = SOURCES[source]()
    with tempfile.TemporaryDirectory() as folder:
        for operation in OPERATIONS.values():
            _outcome(operation, sound, folder)  # loads the kernels that the forked processes share
        for lie in LIES:
            volume = lying(sound, lie)
            for name, operation in OPERATIONS.items():
                result = _apart(operation, volume, folder)
                counts[result[0]] += 1
                if result[0] == "bad":
                    print(json.dumps([source, lie, name, *result[1:]]), flush=True)
    return counts


def _outcome(operation: Any, volume: SparseVolume, folder: str) -> tuple[str, str]:
    try:
        operation(volume, folder)
    except GeokitError:
        return "refused", ""
    except Exception as error:
        return "bad", repr(error)[:300]
    return "answered", ""


def _apart(operation: Any, volume: SparseVolume, folder: str) -> tuple[str, str]:
    def work() -> tuple[str, str]:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        result = _outcome(operation, volume, folder)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before << 10
        return ("bad", f"{grown >> 20} MiB") if grown > MEMORY_BYTES else result

    found, code = forked(work, WALL_SECONDS)
    kind, detail = found or ("bad", f"ended by signal {-code}")
    return kind, detail


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(run_all(sys.argv[1])))
