"""``geokit guide``: lists the guides, or prints one as a program."""

from __future__ import annotations

import re

from geokit._shipped import folder_of
from geokit.cli._program.console import print_table
from geokit.errors import InputError


def guide(name: str | None = None, /) -> None:
    """Print the list of guides, or one of them as a program: its text as comments, its commands and its code.

    geokit guide
    geokit guide hollow > hollow.py

    Args:
        name: A guide of the list; without it the list is printed.
    """
    folder = folder_of("guides")
    rows = re.findall(r"^\| (.*?) \| (.*?) \| \[([\w-]+)\]", (folder / "index.md").read_text(encoding="utf-8"), re.M)
    if name is None:
        print_table(("guide", "I have", "I want"), [(key, have, want) for have, want, key in rows])
        return
    names = [key for _, _, key in rows]
    if name not in names:
        raise InputError(f"guide: there is no {name!r}; choose one of {', '.join(names)}")
    print(as_program((folder / f"{name}.md").read_text(encoding="utf-8")), end="")


def as_program(page: str) -> str:
    """A page of Markdown as Python: code as it is, everything else as comments, without pictures."""
    lines: list[str] = []
    fence = ""
    for line in page.splitlines():
        if line.startswith("```"):
            fence = "" if fence else line[3:]
        elif fence == "python":
            lines.append(line)
        elif not line.startswith("!["):
            text = f"    {line}" if fence else line.lstrip("# ")
            lines.append(f"# {text}" if line else "")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip() + "\n"
