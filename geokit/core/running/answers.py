"""Answers of a process that another one started, on its standard output."""

from __future__ import annotations

import os
from typing import TextIO


def take_stdout() -> TextIO:
    """The standard output for answers alone, line by line.

    From here on what Python and libraries print goes to the standard error: it must not come between the answers.
    """
    answers = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    os.dup2(2, 1)
    return answers
