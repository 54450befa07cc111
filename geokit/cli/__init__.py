"""The command line: one file for each verb, thin over the API."""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0 is success, 1 a request that could not be fulfilled, 2 a command line that makes no sense, 130 an interrupt.
    Errors are one line on stderr; GEOKIT_DEBUG=1 shows where they came from.
    """
    from geokit.cli._run import run

    return run(list(sys.argv[1:] if arguments is None else arguments))
