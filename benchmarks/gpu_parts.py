"""Runs the parts of a GPU benchmark in turn: each is a file of its own, whose ``main(out)`` prints its table.

A part that fails does not stop the others.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from pathlib import Path


def run_parts(name: str, description: str | None) -> None:
    """Parts of ``name`` are ``<name>_<part>.py``; the tables also go to ``<name>.md`` in the folder given by --out."""
    parts = sorted(path.stem.removeprefix(f"{name}_") for path in Path(__file__).parent.glob(f"{name}_*.py"))
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--out", type=Path, help=f"folder for {name}.md")
    arguments = parser.parse_args()
    lines: list[str] = []

    def out(line: str) -> None:
        lines.append(line)
        print(line, flush=True)
        if arguments.out:
            (arguments.out / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")

    failed = []
    for part in arguments.parts:
        out(f"\n## {part}\n")
        try:
            importlib.import_module(f"benchmarks.{name}_{part}").main(out)
        except Exception:
            traceback.print_exc()
            failed.append(part)
            out(f"failed: {traceback.format_exc().splitlines()[-1]}")
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)
