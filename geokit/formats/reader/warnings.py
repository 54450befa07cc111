"""Warnings of the libraries that read files, which a separate process passes on to the caller."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from geokit._warn import warn

# Characters of a warning that are passed on, and number of them.
LONGEST, MOST = 300, 20
# meshio prints its warnings, in lines of some width.
_PRINTED = re.compile(r"^Warning:\s*(.*?)(?=^Warning:|^Error:|\Z)", re.MULTILINE | re.DOTALL)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Collect warnings, also logged and printed ones, in the list that is given; it is complete after the block."""
    found: list[str] = []
    logger, handler = logging.getLogger(), _Handler(found)
    printed = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stderr(printed):
        warnings.simplefilter("always")
        logger.addHandler(handler)
        try:
            yield found
        finally:
            logger.removeHandler(handler)
            # Warnings of other kinds are for developers.
            found += [str(one.message) for one in caught if issubclass(one.category, (UserWarning, RuntimeWarning))]
            found += _PRINTED.findall(printed.getvalue())
            texts = dict.fromkeys(" ".join(text.split())[:LONGEST] for text in found)
            found[:] = [text for text in texts if text][:MOST]
    sys.stderr.write(printed.getvalue())


def warn_of(path: Path, found: Iterable[str]) -> None:
    """Pass on what a reader has warned of."""
    for text in found:
        warn(f"{path}: {text}")


class _Handler(logging.Handler):
    def __init__(self, found: list[str]) -> None:
        super().__init__(logging.WARNING)
        self.found = found

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(Exception):
            self.found.append(record.getMessage())
