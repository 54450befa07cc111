"""The command line as users run it: real processes, their exit codes and what they print."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 240.0

CUBE_OBJ = """\
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 1 4 3 2
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""

Run = Callable[..., "subprocess.CompletedProcess[str]"]


def run_geokit(*arguments: object, cwd: Path | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    done = subprocess.run(
        [sys.executable, "-m", "geokit", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        cwd=cwd,
        env=environment,
    )
    # On a busy machine any step takes two seconds, and says so.
    done.stderr = re.sub(r"^geokit: .* \.\.\. \d+ s\n", "", done.stderr, flags=re.MULTILINE)
    return done


@pytest.fixture(scope="session")
def geokit() -> Run:
    return run_geokit


@pytest.fixture(scope="session")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unit cube, twelve triangles."""
    path = tmp_path_factory.mktemp("cube") / "cube.obj"
    path.write_text(CUBE_OBJ)
    return path


@pytest.fixture(scope="session")
def cube_sdf(cube: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its level set, voxels of 1/16."""
    path = tmp_path_factory.mktemp("sdf") / "cube.nvdb"
    done = run_geokit("convert", cube, path, "--voxel-size", "0.0625")
    assert done.returncode == 0, done.stderr
    return path


def assert_fails(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line on stderr that holds the words, and nothing on stdout."""
    assert done.returncode == code, (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.splitlines() if "compiling" not in line]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("geokit: ")
    for word in words:
        assert word in lines[0]
    assert done.stdout == ""


@pytest.fixture(scope="session")
def fails() -> Callable[..., None]:
    return assert_fails
