"""Command lines that ``--help`` shows below a command's options: those of docs/cli.md."""

from __future__ import annotations

import re
from collections.abc import Sequence

from geokit._shipped import folder_of
from geokit.cli._program.app import GROUPS, VERBS

__all__ = ["examples_of"]

# What to try first, for the help of the program.
FIRST = """\
geokit info bunny.usd
geokit view bunny.usd -o bunny.html
geokit convert bunny.usd bunny.vdb --voxel-size 0.01 --half-width 3
geokit guide
"""


def examples_of(arguments: Sequence[str]) -> list[str]:
    """Examples for a command line that prints help: those of its command, or of the group; [] if it asks for none."""
    asks = bool({"--help", "-h"}.intersection(arguments)) or arguments[:1] == ["help"]
    if not asks and arguments and not (len(arguments) == 1 and arguments[0] in GROUPS):
        return []
    words = [word for word in arguments if not word.startswith("-")]
    first = next((at for at, word in enumerate(words) if word in VERBS), len(words))
    words = words[first : first + 2]
    if not words:
        return FIRST.splitlines()
    page = (folder_of("docs") / "cli.md").read_text(encoding="utf-8")
    lines = re.findall("^geokit .*", page, re.MULTILINE)
    return [line for line in lines if line.split()[1:3] == words] or [
        line for line in lines if line.split()[1] == words[0]
    ]
