"""The command line: one file per verb, each a thin layer over the API."""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0 is success, 1 a request that failed, 2 an invalid command line, 130 an interrupt, 141 a closed stdout. An error is
    one line on stderr; GEOKIT_DEBUG=1 adds the traceback.
    """
    from geokit.cli._run import run

    return run(list(sys.argv[1:] if arguments is None else arguments))
