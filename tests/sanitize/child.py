"""The process that runs under the sanitizer: ``python -m tests.sanitize.child CONFIG``; see __main__.py."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from pathlib import Path

import warp as wp

from geokit.core import launcher
from tests.sanitize.calls import rows
from tests.sanitize.compiler import Clang, Fault
from tests.sanitize.interception import Interception


def main() -> None:
    # Processes that geokit starts have their own limits of memory, which the sanitizer's reservations exceed.
    os.environ.pop("LD_PRELOAD", None)
    config = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    modules = set(config["modules"])
    interception = Interception(
        Clang(*config["clang"]),
        lambda name: not modules or name in modules,
        Path(config["journal"]),
        Path(config["log"]),
        Fault(*config["fault"]) if config["fault"] else None,
    )
    interception.install()
    # One launch for all items, not shares of them: what reads too far does so at the end of its arrays.
    launcher.SLICES_PER_THREAD = 1e-9  # type: ignore[assignment]
    only, done = set(config["only"]), set(config["done"])
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(Path(folder)):
            if row.name in done or (only and row.name not in only):
                continue
            interception.begin(row.name)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                row.call()


if __name__ == "__main__":
    main()
