"""Kernels under clang's address and undefined-behavior sanitizers: ``python -m tests.sanitize [MODULE ...]``.

A module is named as in Python (geokit.mesh.bvh.tree_kernels) or by any part of that; without one all are run. Exit code
1 means findings, 2 that clang is missing. docs/design/sanitizers.md says how it works.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.sanitize import generated
from tests.sanitize.compiler import BUILT, Clang, Fault, clean_environment, find_clang

# Calls that may end the process before we give up: each costs a new start.
MOST_RESTARTS = 8
# Exit code of a process that a sanitizer ends.
FATAL = 99
ADDRESS = {
    "exitcode": FATAL,
    "halt_on_error": 0,
    "detect_leaks": 0,  # Python and warp keep what they have until the end
    "alloc_dealloc_mismatch": 0,  # warp's libraries bring allocation functions of their own
    "allocator_may_return_null": 1,  # a refused allocation is an error of Python's
    "handle_segv": 1,
    "quarantine_size_mb": 64,
}


# Of a report: frames of Python and its libraries, and what surrounds an address.
OF_OTHERS = re.compile(
    r"^ +#\d+ (?!.*(build/sanitize|geokit/|warp/native))|^Shadow bytes|^ *0x|^=>|^  \w[\w -]+: +[0-9a-f]{2}"
)


class Finding(NamedTuple):
    module: str
    kernel: str
    call: str
    text: str


class Outcome(NamedTuple):
    launches: dict[tuple[str, str], int]
    findings: list[Finding]


def sanitize(modules: list[str], clang: Clang, *, calls: Sequence[str] = (), fault: Fault | None = None) -> Outcome:
    """Run the calls and gather what the sanitizers say.

    Args:
        modules: Kernel modules that are looked at; all if there are none.
        clang: From :func:`find_clang`.
        calls: Names of the calls that are run, of those in calls.py; all if there are none.
        fault: Planted in what is compiled.
    """
    launches: dict[tuple[str, str], int] = {}
    findings: list[Finding] = []
    settings = {"modules": modules, "clang": list(clang), "only": list(calls), "fault": fault}
    BUILT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=BUILT) as folder:
        done: list[str] = []
        for start in range(MOST_RESTARTS):
            journal, log = Path(folder) / f"journal{start}", Path(folder) / f"log{start}"
            run = _child({**settings, "done": done}, journal, log, clang)
            entries = [json.loads(line) for line in journal.read_text("utf-8").splitlines()] if journal.exists() else []
            _gather(entries, launches, findings)
            done += [entry["call"] for entry in entries if set(entry) == {"call"}]
            if run.returncode == 0:
                return Outcome(launches, findings)
            if run.returncode > 0 and run.returncode != FATAL:
                raise RuntimeError(f"the calls could not be run:\n{run.stderr}")
            last = entries[-1] if entries else {}
            logs = "\n".join(path.read_text("utf-8", "replace") for path in sorted(Path(folder).glob(f"log{start}.*")))
            # The first report of the launch names the fault; the last one only where it ended.
            unseen = logs[last.get("log", 0) :]
            text = f"the process ended with {run.returncode}\n{unseen[:20000]}\n{run.stderr[-3000:]}"
            findings.append(Finding(last.get("module", ""), last.get("kernel", ""), last.get("call", ""), text))
    raise RuntimeError(f"the process ended {MOST_RESTARTS} times; the last: {findings[-1].text}")


def _child(config: dict[str, Any], journal: Path, log: Path, clang: Clang) -> subprocess.CompletedProcess[str]:
    options = ":".join(f"{key}={value}" for key, value in {**ADDRESS, "log_path": log}.items())
    environment = {
        **clean_environment(),
        "LD_PRELOAD": clang.runtime,
        "ASAN_OPTIONS": options,
        "UBSAN_OPTIONS": f"print_stacktrace=0:log_path={log}",
        "ASAN_SYMBOLIZER_PATH": clang.symbolizer,
        # Kernels that share work by threads are cut into several shares, whatever the machine.
        "GEOKIT_THREADS": "3",
    }
    path = journal.with_suffix(".config")
    path.write_text(json.dumps({**config, "journal": str(journal), "log": str(log)}), encoding="utf-8")
    command = [sys.executable, "-m", "tests.sanitize.child", str(path)]
    return subprocess.run(
        command, stderr=subprocess.PIPE, text=True, errors="replace", env=environment, cwd=generated.ROOT
    )


def _gather(entries: list[dict[str, Any]], launches: dict[tuple[str, str], int], findings: list[Finding]) -> None:
    for entry in entries:
        if entry.get("started"):
            key = entry["module"], entry["kernel"]
            launches[key] = launches.get(key, 0) + 1
        text = entry.get("reported") or ""
        if "different" in entry:
            text = "results differ from those of warp's build: " + "; ".join(entry["different"])
        if text:
            findings.append(Finding(entry["module"], entry["kernel"], entry["call"], text))


def explained(finding: Finding) -> str:
    """A finding as it is printed: generated lines with their text and the Python function that they come from."""
    lines = [f"{finding.module} {finding.kernel}, called by {finding.call}"]
    for line in finding.text.strip().splitlines():
        if OF_OTHERS.search(line):
            continue
        lines.append("    " + line)
        place = re.search(r"(build/sanitize/[^:\s]+\.cpp):(\d+)", line)
        if place and (generated.ROOT / place[1]).exists():
            text = (generated.ROOT / place[1]).read_text(encoding="utf-8")
            number = _physical(text, int(place[2]))
            lines.append(f"        {text.splitlines()[number - 1].strip()}")
            lines.append(f"        translated from {generated.origin(text, number) or 'nothing of its own'}")
    return "\n".join(lines)


def _physical(text: str, line: int) -> int:
    """The line of the file itself: our #line directives are lines too."""
    added = 0
    for number, content in enumerate(text.split("\n"), 1):
        if content.startswith("#line ") and "build/sanitize/" in content:
            added += 1
        elif number - added == line:
            return number
    return line


def chosen(words: list[str]) -> list[str]:
    """Modules whose names contain one of the words."""
    names = generated.module_names()
    found = [name for name in names if any(word in name for word in words)]
    unknown = [word for word in words if not any(word in name for name in names)]
    if unknown:
        raise SystemExit(f"no kernel module is called {', '.join(unknown)}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="./dev sanitize", description=__doc__.split("\n", 1)[0])
    parser.add_argument("module", nargs="*", help="part of the name of a kernel module; all if none is given")
    options = parser.parse_args()
    clang = find_clang()
    if isinstance(clang, str):
        print(f"sanitize: needs {clang}", file=sys.stderr)
        return 2
    os.nice(10)
    outcome = sanitize(chosen(options.module), clang)
    for finding in outcome.findings:
        print(explained(finding), end="\n\n")
    modules = {module for module, _ in outcome.launches}
    print(
        f"{len(modules)} modules, {len(outcome.launches)} kernels, {sum(outcome.launches.values())} launches, "
        f"{len(outcome.findings)} findings"
    )
    return min(len(outcome.findings), 1)


if __name__ == "__main__":
    sys.exit(main())
