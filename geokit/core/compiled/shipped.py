"""Compiled kernels that a wheel brings, so that nothing has to be compiled on the machine of a user.

Warp names an object after everything that went into it: the module's source, all options and the compiler. What a
folder holds under another name than the one that warp asks for was made for another warp, another geokit or another
processor, and is not used. A folder made with another version of warp is not looked into at all.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import logging
import os
from pathlib import Path
from typing import Any, NamedTuple

from geokit.core.base.late_warp import wp
from geokit.core.launches import warp_private

# Where a wheel has its objects, and the name of the table of objects in a folder.
OBJECTS = Path(__file__).resolve().parent / "objects"
INDEX = "index.json"
# A package with nothing but objects for GPUs.
CUDA_PACKAGE = "geokit_cuda_kernels"

_log = logging.getLogger("geokit")


class Shipped(NamedTuple):
    """An object, its metadata, and for GPUs the architecture that it was compiled for."""

    binary: Path
    meta: Path
    arch: int | None


def folders() -> list[Path]:
    """Folders of objects: that of GEOKIT_KERNELS (none where it is empty), else those of the installed packages."""
    if "GEOKIT_KERNELS" in os.environ:
        return [Path(os.environ["GEOKIT_KERNELS"])] if os.environ["GEOKIT_KERNELS"] else []
    package = importlib.util.find_spec(CUDA_PACKAGE)
    return [OBJECTS, *map(Path, package.submodule_search_locations or [] if package else [])]


def count() -> int:
    """Number of objects for the version of warp that is in use."""
    return len(_table())


def find(module: Any, device: "wp.Device", block_dim: int) -> Shipped | None:
    """The object of a kernel module for a device; None where there is none that is whole."""
    table = _table()
    if not table:
        return None
    name = warp_private.module_name(module, block_dim)
    if name is None:
        return None
    for suffix, arch in _suffixes(module, device, block_dim, name):
        entry = table.get(name + suffix)
        if entry is None:
            continue
        binary, meta, digest = entry
        try:
            if digest_of(binary, meta) == digest:
                return Shipped(binary, meta, arch)
        except OSError:
            pass
        _log.warning("kernels: %s is damaged and not used; install its package again", binary)
    return None


def digest_of(*files: Path) -> str:
    """Digest of the bytes of files."""
    digest = hashlib.blake2b(digest_size=16)
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _suffixes(module: Any, device: "wp.Device", block_dim: int, name: str) -> list[tuple[str, int | None]]:
    """Ends of the names of objects that a device can run, best first."""
    if device.is_cpu:
        return [(warp_private.output_name(module, device, block_dim).removeprefix(name), None)]
    # Machine code runs on later minor versions of its architecture, PTX on all later ones.
    older = [arch for arch in range(device.arch, 0, -1) if arch // 10 == device.arch // 10]
    codes: list[tuple[str, int | None]] = [(f".sm{arch}.cubin", arch) for arch in older]
    return codes + [(f".sm{arch}.ptx", arch) for arch in range(device.arch, 0, -1)]


@functools.cache
def _table() -> dict[str, tuple[Path, Path, str]]:
    """Object, metadata and their digest, by the name that warp would give the object."""
    table = {}
    for folder in folders():
        try:
            index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
            if index["warp"] == wp.__version__:
                for name, (binary, meta, digest) in index["objects"].items():
                    table[name] = folder / binary, folder / meta, digest
        except (OSError, ValueError, KeyError, TypeError):  # no folder, or a damaged one
            continue
    return table
