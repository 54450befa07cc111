"""How long a newcomer waits for each guide: ``python -m benchmarks.guides [NAME...]``.

Each guide runs as the program that ``geokit guide NAME`` prints, twice, in an empty home folder. The first run finds no
compiled kernels, as after an installation from source; the second one does, as with a wheel that has them. Times are
those of whole processes, imports and figures included; other programs on the machine prolong them. Prints a Markdown
table for docs/guides/index.md.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from geokit.cli.guide import as_program

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "guides"
# What a page asks for beside its own code.
EXAMPLES = {"ocean": ["examples/ocean.py", "--out", "ocean"]}
RUNS = 2
LONGEST = 600.0


def timed(name: str, home: Path) -> tuple[float, float]:
    """Seconds and CPU seconds of one run of a guide."""
    program = home / f"{name}.py"
    program.write_text(as_program((PAGES / f"{name}.md").read_text(encoding="utf-8")), encoding="utf-8")
    commands = [[str(program)]]
    if name in EXAMPLES:
        example, *options = EXAMPLES[name]
        commands.append([str(ROOT / example), *options])
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "GEOKIT_", "WARP_"))}
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**kept, "HOME": str(home), "GEOKIT_KERNELS": "", "PYTHONPATH": path}
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    for command in commands:
        done = subprocess.run(
            [sys.executable, *command], cwd=home, env=environment, capture_output=True, text=True, timeout=LONGEST
        )
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, used


def main() -> None:
    names = sys.argv[1:] or [path.stem for path in sorted(PAGES.glob("*.md")) if path.stem != "index"]
    print("| guide | first run [s] | CPU time [s] | again [s] | CPU time [s] |\n|---|---:|---:|---:|---:|")
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            home = Path(folder)
            (home / "data").symlink_to(ROOT / "data")
            cells = [f"{seconds:.0f}" for _ in range(RUNS) for seconds in timed(name, home)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
