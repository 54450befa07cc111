"""Write the notebooks of docs/notebooks from the pages of docs/guides: `python docs/notebooks.py`.

A guide is written once, in Markdown. Its notebook has the same text and code, without outputs, and shows each picture
that the code draws. Tests hold the files to the pages, and run them.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

DOCS = Path(__file__).resolve().parent
NAMES = ("hollow", "compare-scans", "mask-to-mesh", "smoke")

# The code of guides leaves its files where it runs.
START = """\
# What is made goes to a new folder.
import os
import tempfile

os.chdir(tempfile.mkdtemp(prefix="geokit-"))
print(os.getcwd())"""


def cells(page: str) -> list[tuple[str, str]]:
    """Kind and text of each cell: "markdown" or "code"."""
    found = []
    for part in re.split(r"(^```python\n.*?^```$|^!\[.*?\]\(.*?\)$)", page, flags=re.MULTILINE | re.DOTALL):
        if part.startswith("```python"):
            found.append(("code", part.removeprefix("```python\n").removesuffix("\n```")))
        elif part.startswith("!["):
            picture = re.search(r"([\w-]+\.\w+)\)$", part)
            assert picture
            found.append(("code", f'from IPython.display import Image as Shown\n\nShown("{picture[1]}")'))
        elif part.strip():
            found.append(("markdown", re.sub(r"\]\(((?!http)[\w./-]+)", _moved, part.strip())))
    return [found[0], ("code", START), *found[1:]]


def _moved(link: re.Match[str]) -> str:
    return f"]({link[1]}" if link[1].startswith("../") else f"](../guides/{link[1]}"


def notebook(page: str) -> str:
    """A page of a guide as the text of an .ipynb file."""
    made = []
    for number, (kind, text) in enumerate(cells(page)):
        code = {"execution_count": None, "outputs": []} if kind == "code" else {}
        made.append(
            {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": text.splitlines(True), **code}
        )
    metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return json.dumps({"cells": made, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def main() -> None:
    for name in NAMES:
        page = (DOCS / "guides" / f"{name}.md").read_text(encoding="utf-8")
        (DOCS / "notebooks" / f"{name}.ipynb").write_text(notebook(page), encoding="utf-8")


if __name__ == "__main__":
    main()
