"""Copies between devices on streams of their own, beside the work of both.

Warp's copies between GPUs make the stream of the source wait for the copy, by an event that threads share.
"""

from __future__ import annotations

import ctypes
import functools

from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp
from geokit.core.launches.cuda_driver import cuda_driver

NON_BLOCKING = 1  # CU_STREAM_NON_BLOCKING
_opening = Lock()


@functools.cache
def copy_stream(device: str, number: int) -> "wp.Stream":
    """A stream of a GPU for copies, which go on while warp frees memory: that waits for each stream that warp makes.

    It is kept for all later calls. The GPU has to be the current one.
    """
    handle = ctypes.c_void_p()
    _require(cuda_driver().cuStreamCreate(ctypes.byref(handle), NON_BLOCKING), "make a stream")
    return wp.Stream(device, cuda_stream=handle.value)


def copy_rows(
    target: "wp.array", at: int, source: "wp.array", first: int, count: int, stream: "wp.Stream | None"
) -> None:
    """Copy ``count`` rows of a contiguous array, from number ``first`` on, into another one, from number ``at`` on.

    The stream is None where both are on the host.

    Raises:
        RuntimeError: The driver refuses.
    """
    if not count:
        return
    if stream is None or target.device == source.device or target.device.is_cpu or source.device.is_cpu:
        wp.copy(target[at : at + count], source[first : first + count], stream=stream)
        return
    row = source.strides[0]
    addresses = (
        ctypes.c_uint64(target.ptr + at * row), ctypes.c_void_p(target.device.context),
        ctypes.c_uint64(source.ptr + first * row), ctypes.c_void_p(source.device.context),
    )  # fmt: skip
    with stream.device.context_guard:
        status = cuda_driver().cuMemcpyPeerAsync(
            *addresses, ctypes.c_size_t(count * row), ctypes.c_void_p(stream.cuda_stream)
        )
    _require(status, "copy")


def open_memory(one: "wp.Device", other: "wp.Device") -> None:
    """Let two GPUs take each other's memory directly, that of warp's pools too, which else goes through the host.

    Copies between GPUs that are under way while access to a pool changes end with CUDA's error 719, and the GPUs are
    lost for the process. So this comes before the work of a call, in one thread, and once both are idle.
    """
    with _opening:
        for target, peer in ((one, other), (other, one)):
            opens = wp.is_peer_access_supported(target, peer) and not wp.is_peer_access_enabled(target, peer)
            opens_pool = wp.is_mempool_access_supported(target, peer) and not wp.is_mempool_access_enabled(target, peer)
            if not (opens or opens_pool):
                continue
            wp.synchronize_device(one)
            wp.synchronize_device(other)
            if opens:
                wp.set_peer_access_enabled(target, peer, True)
            if opens_pool:
                wp.set_mempool_access_enabled(target, peer, True)


def _require(status: int, what: str) -> None:
    if status:
        raise RuntimeError(f"CUDA: could not {what} (error {status})")
