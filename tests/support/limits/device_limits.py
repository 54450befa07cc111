"""Runs every operation on a GPU with little memory left.

``python -m tests.support.limits.device_limits [COUNT [SCALE [BEGIN]]]``, of operations whose names begin so

Measures the peak of each operation's device memory, then fills the GPU so that COUNT shares of that peak are left.
Prints a JSON line for each run that is neither answered nor refused by name, prints to stderr, or leaves the GPU
unusable; then the counts and the estimates that are farthest off.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import tempfile
import threading
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp

import geokit as gk
from tests.support.limits.large_calls import LargeScene, large_calls
from tests.support.limits.memory_runs import estimate_of, outcome
from tests.support.public_calls import Call

DEVICE = "cuda:0"
# Warp's pool grows by pieces of this size.
PIECE = 32 << 20
ROUNDS = ("mesh.", "volume.", "points.")


def quiet(work: Callable[[], Any]) -> tuple[Any, str]:
    """What ``work`` returns, and what native code printed to stderr meanwhile."""
    with tempfile.TemporaryFile() as noise:
        saved = os.dup(2)
        os.dup2(noise.fileno(), 2)
        try:
            result = work()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        noise.seek(0)
        return result, noise.read().decode(errors="replace")[-500:]


def settle() -> None:
    """Give idle memory of the pool back to the driver."""
    gc.collect()
    wp.set_mempool_release_threshold(DEVICE, 0)
    wp.synchronize_device(DEVICE)


def peak_of(call: Call) -> tuple[dict[str, Any], int]:
    """How a call ends, and the most memory of the pool that it took. The pool's own high mark never falls."""
    outcome(call)  # loads kernels, and whatever the operands keep on the device
    settle()
    before, most, stop = wp.get_mempool_used_mem_current(DEVICE), [0], threading.Event()

    def watch() -> None:
        while not stop.wait(1e-4):
            most.append(max(most.pop(), wp.get_mempool_used_mem_current(DEVICE) - before))

    watcher = threading.Thread(target=watch)
    watcher.start()
    ended = outcome(call)
    stop.set()
    watcher.join()
    return ended, most[0]


def with_room(call: Call, room: int) -> tuple[dict[str, Any], str]:
    settle()
    device = wp.get_device(DEVICE)
    ballast = []
    # The driver rounds up, and may refuse the last piece.
    piece = 1 << 33
    while piece >= PIECE and device.free_memory - room > PIECE:
        piece = min(piece, device.free_memory - room)
        try:
            ballast.append(wp.empty(piece // 8, dtype=wp.uint64, device=DEVICE))
        except RuntimeError:
            piece //= 2
    return quiet(lambda: outcome(call))


def works() -> bool:
    corner = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    try:
        settle()
        return bool(gk.mesh.Surface(corner, device=DEVICE).closest_point([[0.25, 0.25, 7.0]]).distance[0] == 7.0)
    except RuntimeError as error:  # after a kernel's fault nothing works any more in this process
        print(error, file=sys.stderr)
        return False


def main(count: int = 20, scale: float = 1.0, begin: str = "") -> None:
    warnings.simplefilter("ignore")
    ends: Counter[str] = Counter()
    estimates = []
    with tempfile.TemporaryDirectory() as folder:
        for call in large_calls(LargeScene(Path(folder), scale, DEVICE)):
            if not (call.name.startswith(ROUNDS) and call.name.startswith(begin)):
                continue
            whole, peak = peak_of(call)
            if whole["end"] != "answered" or peak < PIECE:
                ends["not measured: " + whole["end"]] += 1
                continue
            estimates.append((round(estimate_of(call) / peak, 2), call.name, peak >> 20))
            for k in range(count):
                room = int(1.2 * peak * (k + 0.5) / count)
                found, said = with_room(call, room)
                ends[found["end"]] += 1
                if found["end"] not in ("answered", "refused") or said or not works():
                    print(json.dumps([call.name, room >> 20, found, said]), flush=True)
    print(json.dumps(ends))
    for row in sorted(estimates):
        print(json.dumps(row))


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["20"])[0]), float((sys.argv[2:] or ["1"])[0]), (sys.argv[3:] or [""])[0])
