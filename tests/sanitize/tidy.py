"""clang-tidy over the .inl files of kernels: ``python -m tests.sanitize.tidy [--changed]``.

clang-tidy reads the modules that warp generates, as few as hold every file: bodies of generic functions are checked
where they are called. Findings are named by the .inl file and its line; those in warp's own text are dropped. A module
that was clean is not read again until it changes. ``--changed`` reads those files only that differ from main, or in ten
commits on main.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from geokit.core import launcher
from tests.sanitize import generated
from tests.sanitize.compiler import LANGUAGE, headers

CLEAN = generated.ROOT / "build" / "tidy"
PROGRAM = Path(sys.executable).parent / "clang-tidy"
FOUND = re.compile(r"^(?P<file>/[^:]+):(?P<line>\d+):(?P<column>\d+): (?P<kind>error|warning|note): (?P<text>.*)$")


class Generated(NamedTuple):
    name: str
    source: Path
    regions: tuple[generated.Region, ...]


def modules() -> list[Generated]:
    """Kernel modules that hold .inl files."""
    found = []
    for name in generated.module_names():
        if generated.kernels_of(name):
            source = generated.source_of(name)
            regions = tuple(generated.regions(source.read_text(encoding="utf-8")))
            if regions:
                found.append(Generated(name, source, regions))
    return found


def changed() -> set[str]:
    """The .inl files that differ from main."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=generated.ROOT, capture_output=True, text=True).stdout.strip()

    here = git("rev-parse", "HEAD")
    base = git("merge-base", "HEAD", "origin/main") or git("merge-base", "HEAD", "main")
    if base in ("", here):
        base = git("rev-parse", "--verify", "HEAD~10") or git("rev-list", "--max-parents=0", "HEAD")
    return set(git("diff", "--name-only", base, "--", "*.inl").splitlines())


def fewest(found: list[Generated], wanted: set[str] | None = None) -> list[Generated]:
    """Modules that together hold every .inl file, or every wanted one, each chosen for how many it adds."""
    chosen: list[Generated] = []
    left = {region.path for module in found for region in module.regions}
    if wanted is not None:
        left &= wanted
    while left:
        best = max(found, key=lambda module: (len(left & {region.path for region in module.regions}), module.name))
        left -= {region.path for region in best.regions}
        chosen.append(best)
    return chosen


def tidy(module: Generated) -> list[str]:
    """What clang-tidy finds in the .inl files of a module, one line each; [] at once where that is known."""
    text = module.source.read_text(encoding="utf-8")
    config = generated.ROOT / ".clang-tidy"
    version = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, check=True).stdout
    digest = hashlib.sha256("\0".join([text, config.read_text(), version, *LANGUAGE]).encode()).hexdigest()
    stamp = CLEAN / f"{module.name}_{digest[:16]}"
    if stamp.exists():
        return []
    command = [str(PROGRAM), "--quiet", f"--config-file={config}", str(module.source), "--"]
    # Warp's headers as system headers: what is in them is not ours.
    run = subprocess.run([*command, *LANGUAGE, "-w", "-isystem", str(headers())], capture_output=True, text=True)
    if "clang-diagnostic-error" in run.stdout or (run.returncode and not run.stdout):
        raise RuntimeError(f"clang-tidy cannot read {module.source}:\n{run.stdout}\n{run.stderr}")
    found = list(_placed(run.stdout, module))
    if not found:
        CLEAN.mkdir(parents=True, exist_ok=True)
        stamp.touch()
    return found


def _placed(output: str, module: Generated) -> list[str]:
    found: list[str] = []
    ours = False
    for line in output.splitlines():
        match = FOUND.match(line)
        if match is None:
            continue
        place = _place(match, module)
        if match["kind"] != "note":
            ours = place is not None
        if ours:
            text = f"{place or 'generated code'}: {match['kind']}: {match['text']}"
            found.append(("    " if match["kind"] == "note" else "") + text)
    return found


def _place(match: re.Match[str], module: Generated) -> str | None:
    """Where a finding is in an .inl file; None where it is in none."""
    if Path(match["file"]) != module.source:
        return None
    number = int(match["line"])
    for region in module.regions:
        if 0 <= number - region.first < region.count:
            return f"{region.path}:{number - region.first + region.line}:{match['column']}"
    return None


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.sanitize.tidy", description=__doc__)
    parser.add_argument("--changed", action="store_true", help="only files that differ from main")
    wanted = changed() if parser.parse_args().changed else None
    if wanted == set():
        print("clang-tidy: no .inl file has changed")
        return 0
    launcher.resolve_device("cpu")
    chosen = fewest(modules(), wanted)
    with ThreadPoolExecutor(launcher.thread_count()) as pool:
        found = list(pool.map(tidy, chosen))
    # Two modules may hold one file.
    lines = list(dict.fromkeys(line for lines in found for line in lines))
    count = len(generated.inl_files() if wanted is None else wanted)
    print("\n".join(lines) or f"clang-tidy: {count} .inl files in {len(chosen)} modules, no findings")
    return min(len(lines), 1)


if __name__ == "__main__":
    sys.exit(main())
