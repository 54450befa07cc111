"""`./dev foreign`: other programs, at their newest versions, write files of every format, and geokit reads them.

    ./dev foreign [--format .ply] [--writer open3d] [--keep]

Their packages are in build/foreign-env. --keep renews the files in tests/foreign/kept of writers that the environment
of the tests lacks, and the versions in tests/foreign/kept/versions.txt.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.foreign.compare import faults
from tests.foreign.table import KEPT, OUTSIDE, PACKAGES, ROWS, Row

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / "build/foreign-env/bin/python"
SECONDS = 600.0


def main() -> int:
    parser = argparse.ArgumentParser(prog="./dev foreign")
    parser.add_argument("--format", help="only files of an extension")
    parser.add_argument("--writer", help="only files of a writer")
    parser.add_argument("--keep", action="store_true", help="renew the files in tests/foreign/kept")
    parser.add_argument("--packages", action="store_true", help="print what pip has to install, and end")
    given = parser.parse_args()
    if given.packages:
        print(*sorted({part for package, _ in PACKAGES.values() for part in package.split()}), sep="\n")
        return 0
    rows = [row for row in ROWS if given.format in (None, row.kind) and given.writer in (None, row.writer)]
    wrong, versions = 0, {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for writer in dict.fromkeys(row.writer for row in rows):
            own = [row for row in rows if row.writer == writer]
            failed = _make(folder, own)
            versions[writer] = _version(writer)
            for row in own:
                found = [failed[row.id]] if row.id in failed else _faults(row, folder / row.id)
                wrong += bool(found)
                print(f"{'WRONG' if found else 'right'}  {row.id}  {versions[writer]}", *found, sep="\n       ")
                if given.keep and writer in OUTSIDE and not row.large and row.id not in failed:
                    shutil.rmtree(KEPT / row.id, ignore_errors=True)
                    shutil.copytree(folder / row.id, KEPT / row.id)
    if given.keep and rows == ROWS:
        text = "".join(f"{writer} {version}\n" for writer, version in sorted(versions.items()))
        (KEPT / "versions.txt").write_text(text)
    print(f"{len(rows)} files, {wrong} wrong")
    return int(wrong > 0)


def _faults(row: Row, folder: Path) -> list[str]:
    try:
        return faults(row, folder)
    except Exception as error:  # an internal error of geokit is one too
        return [f"{type(error).__name__}: {error}"]


def _make(folder: Path, rows: list[Row]) -> dict[str, str]:
    """What failed, by the file's id."""
    command = [PYTHON, "-m", "tests.foreign.make", folder, *(row.id for row in rows)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=SECONDS)
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        return {row.id: f"the writer ended with status {done.returncode}: {last}" for row in rows}
    return dict(json.loads(done.stdout))


def _version(writer: str) -> str:
    package = PACKAGES[writer][0].split("[")[0].split()
    if package:
        code = f"import importlib.metadata as m; print(m.version({package[0]!r}))"
        return subprocess.run([PYTHON, "-c", code], capture_output=True, text=True).stdout.strip()
    name = {"assimp": "assimp-utils", "pyopenvdb": "python3-openvdb", "vdb_tool": "libopenvdb-tools"}.get(writer)
    done = subprocess.run(
        ["dpkg-query", "-W", "-f=${Version}", name or "libnanovdb-tools"], capture_output=True, text=True
    )
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
