"""Damaged files of every format: ``python -m tests.fuzz --format nvdb --count N``, ``python -m tests.fuzz --native S``.

Exit code 1 means faults, 2 that clang is missing. docs/reliability.md says what was found.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

from tests.fuzz.campaign import run
from tests.fuzz.originals import TARGETS, Target

# The rest are usually the same ones.
MOST_FAULTS = 20


def chosen(name: str) -> list[Target]:
    """Targets of a format (nvdb), of a content (points), of both (points.ply), or all."""
    found = [t for t in TARGETS if name in ("all", t.content, t.kind, t.kind[1:], f"{t.content}{t.kind}")]
    if not found:
        raise SystemExit(f"nothing is read from {name!r}; choose of {', '.join(sorted({t.kind for t in TARGETS}))}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="./dev fuzz", description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "--format", default="all", help="an extension (nvdb), or mesh, points, rays, volume; points.ply"
    )
    parser.add_argument("--count", type=int, default=200, help="mutants of each")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--keep", type=Path, help="folder for mutants that are faults")
    parser.add_argument("--native", type=int, metavar="SECONDS", help="run libFuzzer on each C++ reader instead")
    options = parser.parse_args()
    os.nice(10)
    if options.native is not None:
        from tests.fuzz.libfuzzer import fuzz_native

        return fuzz_native(options.native)
    faults = 0
    for target in chosen(options.format):
        start = time.monotonic()
        seeds = range(options.first, options.first + options.count)
        tally = run(target, seeds, workers=options.workers, keep=options.keep)
        told = {
            "target": f"{target.content}{target.kind}",
            "mutants": tally.ends.total(),
            "ends": dict(tally.ends.most_common()),
            "differs": {f"{what}{' (mended)' * mended}": n for (mended, what), n in tally.differing.most_common()},
            "slowest": tally.slowest,
            "grown": tally.grown,
            "seconds": round(time.monotonic() - start),
        }
        print(json.dumps(told), flush=True)
        for fault in tally.faults[:MOST_FAULTS]:
            print("   ", json.dumps(fault), flush=True)
        faults += len(tally.faults)
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())
