"""Loads compiled kernels: those that came with the package, else those in warp's folder of compiled kernels.

What is damaged in the folder is compiled again, and an unusable folder is replaced. Warp loads whatever it finds. A
flipped bit in an object crashes the process, so a digest beside each object is compared first, and an object without
one is not loaded.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geokit.core.base.late_warp import wp
from geokit.core.base.private_folder import OTHERS, distrust, make_own, remove_folder, require_trusted, temporary_parent
from geokit.core.base.system import limits
from geokit.core.compiled import cpu_level, shipped
from geokit.core.compiled.shipped import Shipped, digest_of
from geokit.core.launches import warp_private
from geokit.core.memory.available_memory import available_host
from geokit.core.memory.needs import is_out_of_memory, require_free
from geokit.errors import DeviceMemoryError, FileAccessError, InputError

# What the system says of a folder that cannot be written to.
UNUSABLE = {errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.ENOSPC, errno.ENOTDIR, errno.EPERM, errno.EROFS}
# Folders for temporary files besides Python's own.
TEMPORARY = ("/dev/shm", "/var/tmp")
# A folder with less free space [bytes] counts as full. A module takes 0.1 MB.
LEAST_FREE = 1 << 22
# Memory for loading a compiled module, and for compiling one.
LOAD_BYTES, COMPILE_BYTES = 20 << 20, 300 << 20
# Stack of a thread: each of warp's kernels for CPUs takes 256 kB for tiles, and the neighbor search 341 kB of its own.
# Where there is less, the process ends.
LEAST_STACK = 1 << 20
# Digest of a module's object and metadata.
DIGEST_SUFFIX = ".blake2"
MOST_CURES = 2
# Another process that has compiled the module writes the digest when it has loaded it: within this time [s].
PATIENCE = 3.0

_log = logging.getLogger("geokit")


def initialize(warp: Any, init: Callable[[], None]) -> None:
    """Call ``init``, which calls ``warp.init()``; with another kernel cache if the usual folder cannot be made.

    Raises:
        FileAccessError: No folder can be made.
    """
    try:
        init()
    except OSError as error:
        _replace_folder(warp, error)
        init()


def load(module: Any, device: "wp.Device", block_dim: int, announce: Callable[[str], None] | None = None) -> None:
    """Load a kernel module: as it came with the package, else from the cache; or compile it.

    A module that is damaged in the cache is compiled again; a cache that cannot be written to is replaced by a
    temporary folder. The log says so in one line, which Python prints to stderr unless logging is configured.

    Args:
        module: A module of warp.
        device: The device to load it for.
        block_dim: Threads of a block.
        announce: Called with the module's name before it is compiled.
    Raises:
        DeviceMemoryError: There is too little memory to load or compile it, or too little stack to run it.
        FileAccessError: It has to be compiled, and a folder for it or for temporary files cannot be written to.
    """
    if device.is_cpu:
        _require_stack(module)
    cpu_level.choose(module)
    found = shipped.find(module, device, block_dim)
    # LLVM ends the process where it gets no memory.
    files = warp_private.module_files(module, device, block_dim)
    is_compiled = found is not None or (files is not None and files[0].exists())
    # Tests of operations pretend that little memory is left; whether kernels are loaded by then must not matter.
    require_free(LOAD_BYTES if is_compiled else COMPILE_BYTES, f"kernels of {module.name}", have=available_host())
    if found is not None and _load_shipped(module, device, block_dim, found):
        return
    if not is_compiled:
        temporary_parent()  # warp's compiler writes there
    for _ in range(MOST_CURES):
        try:
            return _load_checked(module, device, block_dim, announce)
        except Exception as error:
            if is_out_of_memory(error):
                raise
            _cure(module, block_dim, error)
    return _load_checked(module, device, block_dim, announce)


def _require_stack(module: Any) -> None:
    if (soft := limits("STACK")[0]) < LEAST_STACK:
        raise DeviceMemoryError(
            f"kernels of {module.name}: need {LEAST_STACK >> 10} kB of stack, and the limit is {soft >> 10} kB "
            "(ulimit -s); raise it, as in ulimit -s 8192",
            need=LEAST_STACK,
        )


def _load_shipped(module: Any, device: "wp.Device", block_dim: int, found: Shipped) -> bool:
    """Load what came with the package; False if this machine cannot."""
    try:
        warp_private.load_module(module, device, block_dim, found)
    except Exception as error:  # a driver that is too old, or another warp than its version says
        if is_out_of_memory(error):
            raise
        _log.warning("kernels: %s cannot be used (%s)", found.binary, _first_line(error))
        warp_private.mark_modified(module)
        return False
    return True


def _load_checked(module: Any, device: "wp.Device", block_dim: int, announce: Callable[[str], None] | None) -> None:
    files = warp_private.module_files(module, device, block_dim)
    if files is None:
        warp_private.load_module(module, device, block_dim)
        return
    binary, meta = files
    with contextlib.suppress(FileNotFoundError):  # there is nothing to be loaded
        require_trusted(folder := binary.parent.parent)
        bits = OTHERS if folder.stat().st_mode & 0o011 else 0  # else nobody gets there, whatever the umask was
        for place in (binary.parent, *files):
            if reason := distrust(place, place.lstat(), bits):
                raise OSError(errno.EIO, reason, str(place))
    if not binary.exists() and _is_full(binary.parent.parent):
        # LLVM ends the process when it cannot write an object.
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(binary))
    for file in files:
        if file.exists() and not file.is_file():  # of a FIFO, reading would wait for ever
            raise OSError(errno.EIO, "no regular file", str(file))
    record = binary.with_name(binary.name + DIGEST_SUFFIX)
    until = time.monotonic() + PATIENCE
    while binary.exists() and not record.is_file() and time.monotonic() < until:
        time.sleep(PATIENCE / 50)
    known = record.read_text() if record.is_file() else None
    if known is not None and known != digest_of(binary, meta):
        raise OSError(errno.EIO, "the digest differs", str(binary))
    if known is None and binary.exists():
        raise OSError(errno.EIO, "the digest is missing", str(binary))
    if announce and not (binary.exists() and meta.exists()):
        announce(module.name)
    try:
        warp_private.load_module(module, device, block_dim)
        if known is None:
            _keep(record, digest_of(binary, meta))
    except BaseException as error:
        if not isinstance(error, Exception):  # an interrupt
            _forget_half(binary, record)
        raise


def _forget_half(binary: Path, record: Path) -> None:
    """Remove what this thread has not finished. An object without a digest would count as damaged the next time."""
    for draft in binary.parent.parent.glob(f"{binary.parent.name}_p{os.getpid()}_t{threading.get_ident()}"):
        remove_folder(draft)
    if not record.is_file():
        binary.unlink(missing_ok=True)


def _keep(record: Path, text: str) -> None:
    draft = record.with_name(f"{record.name}.{os.getpid()}")
    try:
        draft.write_text(text)
        draft.replace(record)
    except BaseException as error:
        draft.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        # Read-only or full: the module is loaded, and compiled again the next time.


def _cure(module: Any, block_dim: int, error: Exception) -> None:
    """Make room for another attempt, or raise the error again."""
    folder = warp_private.module_folder(module, block_dim)
    is_refused = isinstance(error, InputError) or getattr(error, "errno", None) in UNUSABLE
    if is_refused or _is_full(Path(str(wp.config.kernel_cache_dir))):
        _replace_folder(wp, error)
    elif folder is None or warp_private.has_failed_to_build(module):
        raise error
    else:
        remove_folder(folder)
        if folder.exists():
            _replace_folder(wp, error)
        else:
            _log.warning("kernel cache: %s was damaged (%s) and is compiled again", folder, _first_line(error))
    warp_private.mark_modified(module)


def _is_full(folder: Path) -> bool:
    existing = next((place for place in (folder, *folder.parents) if place.is_dir()), folder)
    try:
        return shutil.disk_usage(existing).free < LEAST_FREE
    except OSError:
        return True


def _replace_folder(warp: Any, error: Exception) -> None:
    """Set another folder for compiled kernels.

    Raises:
        FileAccessError: There is no other folder.
    """
    former = warp.config.kernel_cache_dir
    other = _private_folder(former)
    if other is None:
        raise FileAccessError(
            f"kernel cache: {former} cannot be used ({_first_line(error)}), nor can a folder for temporary files; "
            "name one that can be written to in the variable WARP_CACHE_PATH"
        ) from error
    warp.config.kernel_cache_dir = str(other)
    _log.warning(
        "kernel cache: %s cannot be used (%s); %s is used instead; WARP_CACHE_PATH names another folder",
        former,
        _first_line(error),
        other,
    )


def _private_folder(former: Any) -> Path | None:
    """A folder for temporary files that only this user can write to; later processes find it again."""
    name = f"geokit-kernels-{os.getuid()}" if hasattr(os, "getuid") else "geokit-kernels"
    parents = list(TEMPORARY)
    with contextlib.suppress(FileNotFoundError):  # not one that Python knows can be written to
        parents.insert(0, tempfile.gettempdir())
    for parent in dict.fromkeys(parents):
        folder = Path(parent) / name
        if str(folder) == str(former):
            continue
        try:
            if _is_full(folder.parent):
                continue
            make_own(folder)
            require_trusted(folder)
            if os.access(folder, os.W_OK):
                return folder
        except (OSError, InputError):
            continue
    return None


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
