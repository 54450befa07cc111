"""Whether launches go into a CUDA graph, which makes them again whenever its owner likes, without the host."""

from __future__ import annotations

from geokit.core.base.late_warp import wp
from geokit.errors import InputError

# What warp says where the host would wait.
WAITED = "while graph capture is active"


def is_captured(device: "wp.Device") -> bool:
    """Whether a graph is captured on a device."""
    return device.is_cuda and bool(device.is_capturing)


def refuse(device: "wp.Device", what: str) -> None:
    """Refuse what is read on the host, or copied from there.

    Raises:
        InputError: A graph is captured on the device.
    """
    if is_captured(device):
        raise InputError(f"{what}, and a CUDA graph would not do that again; do it before the capture")
