"""The command line as users run it: exit codes, and what is printed."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import pytest

from geokit.cli import main

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
    done.stderr = _without_steps(done.stderr)
    return done


def run_here(*arguments: object, cwd: Path | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    """The same in this process, which has the packages and the kernels: that takes a tenth of the time."""
    words = [str(argument) for argument in arguments]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        if cwd is not None:
            patch.chdir(cwd)
        for name, value in variables.items():
            patch.setenv(name, value)
        with _file() as out, _file() as err:
            with _caught(1, "stdout", out), _caught(2, "stderr", err):
                code = main(words)
            for file in (out, err):
                file.seek(0)
            return subprocess.CompletedProcess(words, code, out.read(), _without_steps(err.read()))


def _file() -> IO[str]:
    return tempfile.TemporaryFile("w+", encoding="utf-8", errors="surrogateescape")


@contextlib.contextmanager
def _caught(number: int, name: str, file: IO[str]) -> Iterator[None]:
    """A file gets what is written to a standard stream, also by other than Python."""
    stream, kept = getattr(sys, name), os.dup(number)
    stream.flush()
    os.dup2(file.fileno(), number)
    setattr(sys, name, file)
    try:
        yield
    finally:
        file.flush()
        setattr(sys, name, stream)
        os.dup2(kept, number)
        os.close(kept)


def _without_steps(text: str) -> str:
    """On a busy machine any step takes two seconds, and says so."""
    return re.sub(r"^geokit: .* \.\.\. \d+ s\n", "", text, flags=re.MULTILINE)


@pytest.fixture(scope="session")
def geokit() -> Run:
    return run_here


@pytest.fixture(scope="session")
def geokit_process() -> Run:
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
    done = run_here("convert", cube, path, "--voxel-size", "0.0625")
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
