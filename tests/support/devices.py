"""The devices that tests run on: the CPU, and every GPU that there is."""

from __future__ import annotations

from geokit.core import launcher

__all__ = ["DEVICES"]

DEVICES = ["cpu", *launcher.cuda_devices()]
