"""Measures the memory of every operation, and runs each under limits of its address space.

python -m tests.support.limits.memory_runs peaks          # a JSON line for each operation
python -m tests.support.limits.memory_runs limits [COUNT]  # COUNT limits for each; prints what ends badly

PART=2/8 takes every eighth operation, ALL=1 the slow ones too, ONCE=1 each function in its last form, which does most;
SCALE=0.5 halves the operands, WARM=1 loads all kernels first.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from geokit.core.memory import host_pool
from geokit.errors import DeviceMemoryError, GeokitError
from geokit.render import _view
from tests.support.forked import forked
from tests.support.limits.large_calls import LargeScene, large_calls
from tests.support.public_calls import MORE, Call, Scene, public_calls

CPU_SECONDS = 120
# A process that waits for so long waits for ever.
IDLE_SECONDS = 30
# Estimates are within this share of the peak, or within what libraries and allocators take beside the data.
SHARE, SLACK_BYTES = 0.25, 24 << 20
# A search over many trials, whose need nobody knows beforehand; sizes that are known only inside; lists by blocks that
# fit in what is free.
NO_ESTIMATE = {
    "volume.adaptive_from_mesh", "volume.plan", "volume.from_mesh(tolerance)", "volume.from_channel",
    "points.NeighborGrid.radius_search_blocks", "points.NeighborGrid.radius_search_blocks(own)", "mesh.TriangleMesh",
    "points.NeighborGrid.radius_search_blocks(groups)", "points.NeighborGrid.radius_search_blocks(periodic)",
    "points.PointCloud", "volume.inspect", "native.inspect_vdb", "mesh.as_mesh", "volume.to_pyvista",
    "volume.from_mesh_file", "points.process_file", "points.load_tiles",
    "mesh.audit_file", "mesh.wrap",
}  # fmt: skip
# Over a second, or the same as another call.
SLOW = {
    "mesh.simplify", "mesh.simplify(face_count)", "mesh.from_volume(tolerance)", "mesh.from_volume_with_deviation",
    "mesh.sample_surface(radius)", "volume.adaptive_from_mesh", "volume.plan", "volume.from_mesh(tolerance)",
    "volume.from_mesh(openvdb)", "volume.smooth", "volume.integrate", "volume.integrate(emission)",
    "volume.SparseVolume.integrate", "native.mesh_to_level_set", "accuracy.run", "accuracy.default_subjects",
    "accuracy.write_stability", "accuracy.write_report", "accuracy.follow", "accuracy.sweeps", "render.figure",
    "render.figure(points)", "render.figure(volume)", "threads.Team.record", "threads.Team.run",
}  # fmt: skip


def status(name: str) -> int:
    """A size of /proc/self/status [bytes]."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith(f"{name}:"))


def apart(work: Callable[[], Any]) -> dict[str, Any]:
    """What ``work`` returns in a forked process: JSON; with what it printed to stderr."""

    def bounded() -> Any:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
        return work()

    with tempfile.TemporaryFile() as noise:
        found, code = forked(bounded, IDLE_SECONDS, noise)
        noise.seek(0)
        said = noise.read().decode(errors="replace")[-600:]
    result = {"end": "died", "what": str(code)} if found is None else found
    return {**result, "said": said}


def forget_pools() -> None:
    """Free the buffers that earlier operations left for later ones."""
    gc.collect()
    host_pool._pool._idle.clear()
    host_pool._pool._bytes = 0


def ready() -> None:
    """Start what a process starts once: threads and their allocators' memory."""
    from geokit.core import launcher

    forget_pools()
    launcher.pool().map(lambda _: bytearray(1 << 16), range(64))


def peak_of(call: Call) -> dict[str, Any]:
    ready()
    stated = estimate_of(call)
    ready()
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")
    size, resident, highest = status("VmSize"), status("VmRSS"), status("VmPeak")
    start = time.perf_counter()
    result = outcome(call)
    result["s"] = round(time.perf_counter() - start, 3)
    result["need"] = stated
    grown, resident = status("VmPeak"), status("VmHWM") - resident
    # The highest mark of mappings cannot be reset: threads have passed it for a moment.
    return {**result, "mapped": grown - size if grown > highest else min(grown - size, resident), "resident": resident}


def estimate_of(call: Call) -> int:
    """What geokit states that a call needs; 0 if it cannot know."""
    function, given = call.function, dict(call.arguments)
    if isinstance(function, type):
        found = getattr(function.__init__, "_geokit_bytes", None)
        return found(None, **given) if found else 0
    if call.name.endswith(".show"):  # of the room that draws
        return int(_view.show._geokit_bytes(function.__self__))
    if call.name.startswith("volume.SparseVolume."):  # these forward to functions
        volume = function.__self__
        function, given["volume"] = getattr(gk.volume, function.__name__, function), volume
    found = getattr(function, "_geokit_bytes", None)
    if found is None:
        return 0
    more = [given.pop(p.name) for p in call.parameters if p.kind is p.VAR_POSITIONAL and p.name in given]
    own = [function.__self__] if hasattr(function, "__self__") else []
    if more:
        first = [given.pop(p.name) for p in call.parameters if p.kind is p.POSITIONAL_OR_KEYWORD and p.name in given]
        return found(*own, *first, *more[0], **given)
    return found(*own, **given)


def outcome(call: Call) -> dict[str, Any]:
    try:
        call()
    except DeviceMemoryError as error:
        return {"end": "refused", "what": str(error), "need": error.need}
    except GeokitError as error:
        return {"end": "named", "what": f"{type(error).__name__}: {error}"}
    except BaseException as error:
        return {"end": "raw", "what": f"{type(error).__name__}: {error}"[:300]}
    return {"end": "answered", "what": ""}


def fill_heap() -> list[Any]:
    """Take what earlier work has freed in the heap: without room for new mappings, malloc serves arrays from there."""
    kept: list[Any] = []
    for size in (1 << 24, 1 << 22, 1 << 20, 1 << 18, 1 << 16):
        with contextlib.suppress(MemoryError):
            while True:
                kept.append(np.empty(size, np.uint8))
    return kept


def grow_stack() -> None:
    """Grow the stack: where it cannot grow later, the system ends the process, whatever the operation does."""
    nested: list[Any] = []
    for _ in range(700):
        nested = [nested]
    repr(nested)


def under(call: Call, limit: int) -> dict[str, Any]:
    forget_pools()
    grow_stack()
    size = status("VmSize")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))
    kept = fill_heap()
    resource.setrlimit(resource.RLIMIT_AS, (size + limit,) * 2)
    result = outcome(call)
    del kept
    return result


def warm(folder: Path, names: Sequence[str]) -> None:
    """Load the kernels that forked processes then share. Threads of OpenVDB and VTK would not survive a fork."""
    folder.mkdir()
    for call in public_calls(Scene(folder)):
        if names and call.name not in names and call.name.partition("(")[0] not in names:
            continue
        if not any(word in call.name for word in ("vdb", "native", "render", "write", "mesh.save", "accuracy")):
            outcome(call)


def runs(names: Sequence[str], limits: int, scale: float) -> Iterator[dict[str, Any]]:
    """The peak of each operation, each followed by its ends under ``limits`` limits up to 1.2 times the peak."""
    with tempfile.TemporaryDirectory() as folder:
        if not limits or os.environ.get("WARM"):
            warm(Path(folder) / "warm", names)
        scene = LargeScene(Path(folder), scale)
        # What an import takes is no need of an operation.
        for library in ("trimesh", "meshio", "pyvista", *(("dask.array", "distributed") if MORE else ())):
            importlib.import_module(library)
        # By VTK, whose threads would not survive a fork.
        apart(lambda: {"end": gk.mesh.save(Path(folder) / "mesh.vtp", scene.mesh)})
        # What is here stays here: forked processes look for garbage among what is theirs only.
        gc.collect()
        gc.freeze()
        part, parts = (int(word) for word in os.environ.get("PART", "0/1").split("/"))
        for call in _chosen(list(large_calls(scene))[part::parts], names):
            peak = apart(lambda call=call: peak_of(call))
            yield {"name": call.name, **peak}
            for step in range(limits):
                limit = int(max(peak.get("mapped", 0), 8 << 20) * 1.2 * (step + 0.5) / limits)
                yield {"name": call.name, "limit": limit, **apart(lambda call=call, limit=limit: under(call, limit))}


def _chosen(calls: Sequence[Call], names: Sequence[str]) -> list[Call]:
    if names:
        return [call for call in calls if call.name in names or call.name.partition("(")[0] in names]
    quick = [call for call in calls if call.name not in SLOW or os.environ.get("ALL")]
    return list({call.name.partition("(")[0]: call for call in quick}.values()) if os.environ.get("ONCE") else quick


def faults(found: Sequence[dict[str, Any]]) -> list[str]:
    """What is wrong with the results of :func:`runs`."""
    wrong, mapped = [], 0
    for row in found:
        if "limit" not in row:
            mapped, fine = row.get("mapped", 0), row["end"] == "answered" and not row["said"]
            # Room that was mapped before, in holes of the heap and in arenas of threads, is needed as well.
            peak = max(mapped, min(row.get("need", 0), row.get("resident", 0)))
            if row.get("need") and abs(row["need"] - peak) > max(SHARE * peak, SLACK_BYTES):
                wrong.append(f"{row['name']}: needs {mapped >> 20} MiB, the estimate is {row['need'] >> 20} MiB")
        else:
            fine = row["end"] in ("answered", "refused") and not row["said"]
            if row["end"] == "refused" and not row["need"] and row["name"] not in NO_ESTIMATE:
                fine = False
        if not fine:
            wrong.append(json.dumps(row))
    return wrong


def main(what: str, *more: str) -> None:
    warnings.simplefilter("ignore")
    limits = next((int(word) for word in more if word.isdecimal()), 20) if what == "limits" else 0
    found = []
    for row in runs([word for word in more if not word.isdecimal()], limits, float(os.environ.get("SCALE", "1"))):
        found.append(row)
        print(json.dumps(row), flush=True)
    for line in faults(found):
        print(f"FAULT {line}", flush=True)


if __name__ == "__main__":
    if "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        # Without it, arrays lie in holes of the heap that earlier ones left, which hides them from the figures.
        os.environ["MALLOC_MMAP_THRESHOLD_"] = str(1 << 17)
        os.execv(sys.executable, [sys.executable, "-m", "tests.support.limits.memory_runs", *sys.argv[1:]])
    main(*sys.argv[1:])
