"""Compiles the kernels that a wheel brings: ``python packaging/kernels.py FOLDER [--cpu LEVEL ...] [--cuda ARCH ...]``.

FOLDER is ``geokit/core/compiled/objects`` of an unpacked wheel, or ``geokit_cuda_kernels`` of one for GPUs. Run it with
the version of warp that the wheel is for; other versions ignore what it writes. It needs no GPU. Objects are compiled
in warp's kernel cache (WARP_CACHE_PATH) and copied from there, so that a second run takes seconds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from geokit.core.compiled import cpu_level, modules, shipped
from geokit.core.launcher import BLOCK_DIM


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cpu", nargs="*", default=[], choices=list(cpu_level.LEVELS), metavar="LEVEL")
    parser.add_argument("--cuda", nargs="*", default=[], metavar="ARCH", help="80 for machine code, 80-ptx for PTX")
    parser.add_argument("--only", nargs="*", metavar="MODULE", help="kernel modules, by default all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    given = parser.parse_args()
    import warp as wp

    given.folder.mkdir(parents=True, exist_ok=True)
    names = given.only or modules.kernel_modules()
    objects: dict[str, tuple[str, str, str]] = {}
    build = partial(compile_module, folder=given.folder, levels=given.cpu, archs=given.cuda)
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        for done, (name, made) in enumerate(zip(names, pool.map(build, names), strict=True), 1):
            objects |= made
            print(f"{done}/{len(names)} {name}: {len(made)}", file=sys.stderr, flush=True)
    index = {"warp": wp.__version__, "objects": dict(sorted(objects.items()))}
    (given.folder / shipped.INDEX).write_text(json.dumps(index, indent=0), encoding="utf-8")
    size = sum((given.folder / binary).stat().st_size for binary in {binary for binary, _, _ in objects.values()})
    print(f"{len(objects)} objects, {size / 1e6:.1f} MB, for warp {wp.__version__}: {given.folder}")
    return 0


def compile_module(name: str, folder: Path, levels: list[str], archs: list[str]) -> dict[str, tuple[str, str, str]]:
    """Compile a kernel module and copy the objects.

    Returns:
        File of the object, file of its metadata and digest of both, by the name that warp gives the object.
    """
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    made = {}
    for module in modules.warp_modules(name):
        for level in levels:
            _set(module, level, 1)
            made.update(_copied(module, wp.compile_aot_module(module, "cpu"), folder))
        if "_cpu_kernels" not in name:
            for arch in archs:
                number, _, kind = arch.partition("-")
                _set(module, cpu_level.NATIVE, BLOCK_DIM)
                paths = wp.compile_aot_module(module, arch=int(number), use_ptx=kind == "ptx")
                ((_, entry),) = _copied(module, paths, folder).items()
                # The name follows the flags for CPUs too, though they do not change the object.
                for level in (*cpu_level.LEVELS, cpu_level.NATIVE):
                    _set(module, level, BLOCK_DIM)
                    made[f"{module.get_module_identifier(BLOCK_DIM)}.sm{number}.{kind or 'cubin'}"] = entry
    return made


def _set(module: Any, level: str, block_dim: int) -> None:
    import warp as wp

    wp.set_module_options({"cpu_compiler_flags": cpu_level.flags_of(level), "block_dim": block_dim}, module)


def _copied(module: Any, paths: list[Path], folder: Path) -> dict[str, tuple[str, str, str]]:
    (binary,) = paths
    meta = binary.with_name(f"{module.get_module_identifier()}.meta")
    for file in (binary, meta):
        shutil.copyfile(file, folder / file.name)
    return {binary.name: (binary.name, meta.name, shipped.digest_of(binary, meta))}


if __name__ == "__main__":
    sys.exit(main())
