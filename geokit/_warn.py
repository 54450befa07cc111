"""Warnings that name the line of the caller, however deep in geokit they arise."""

from __future__ import annotations

import sys
import warnings

from geokit.core.base.printable import in_one_line

# Packages through which geokit calls itself; their frames are no caller's. From Python 3.12 on, warnings.warn can skip
# frames by their files.
_PASSED = {"contextlib", "functools", "geokit", "jax", "torch", "warp"}


def warn(message: str) -> None:
    """Issue a UserWarning at the innermost line outside of geokit.

    Messages quote files, whatever stands there: they become one line that every terminal prints.
    """
    frame = sys._getframe(1)
    outside = frame
    while str(outside.f_globals.get("__name__")).partition(".")[0] in _PASSED:
        if outside.f_back is None:
            # A thread of geokit's own has no other caller.
            outside = frame
            break
        outside = outside.f_back
    place = outside.f_globals
    warnings.warn_explicit(
        in_one_line(message, None),
        UserWarning,
        outside.f_code.co_filename,
        outside.f_lineno,
        module=place.get("__name__"),
        registry=place.setdefault("__warningregistry__", {}),
    )
