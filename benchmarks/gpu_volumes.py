"""Volumes on a GPU, checked against the CPU, timed beside raw warp: ``python -m benchmarks.gpu_volumes [--out DIR]``.

Each part is a file of its own, ``gpu_volumes_<part>.py``, whose ``main(out)`` prints its table; a part that fails does
not keep the others. No OpenVDB is needed.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from pathlib import Path


def parts() -> list[str]:
    return sorted(path.stem.removeprefix("gpu_volumes_") for path in Path(__file__).parent.glob("gpu_volumes_*.py"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=parts(), default=parts())
    parser.add_argument("--out", type=Path, help="folder for gpu_volumes.md")
    arguments = parser.parse_args()
    lines: list[str] = []

    def out(line: str) -> None:
        lines.append(line)
        print(line, flush=True)
        if arguments.out:
            (arguments.out / "gpu_volumes.md").write_text("\n".join(lines) + "\n", encoding="utf-8")

    failed = []
    for part in arguments.parts:
        out(f"\n## {part}\n")
        try:
            importlib.import_module(f"benchmarks.gpu_volumes_{part}").main(out)
        except Exception:
            traceback.print_exc()
            failed.append(part)
            out(f"failed: {traceback.format_exc().splitlines()[-1]}")
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
