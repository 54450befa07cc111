"""What README and the tour show is run: Python, commands, the verbs of the two set-up commands, links."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import run_geokit, run_here
from tests.support.effort import of_all

ROOT = Path(__file__).resolve().parents[2]
README, TOUR = (ROOT / "README.md", ROOT / "docs" / "tour.md")

FIRST = {"torus.ply", "cloud.ply"}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def run_python(code: str, folder: Path) -> str:
    # The last line opens a browser, as BROWSER says.
    environment = {**os.environ, "BROWSER": "true", "TMPDIR": str(folder.parent)}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, env=environment)
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An otherwise empty folder with what the first program leaves: it and the commands need no checkout."""
    (first,) = blocks(README, "py")
    place = tmp_path / "empty"
    place.mkdir()
    run_python(first, place)
    assert {path.name for path in place.iterdir()} == FIRST
    return place


@pytest.mark.slow
def test_python(folder: Path) -> None:
    (tour,) = blocks(TOUR, "python")
    assert run_python(tour, folder).splitlines() == ["True"]
    assert {path.name for path in folder.iterdir()} == {*FIRST, "torus.png", "torus.vdb", "closest.vtp", "scene.html"}


@pytest.mark.slow
def test_commands(folder: Path) -> None:
    shown = [line for page in (TOUR, README) for block in blocks(page, "sh") for line in block.splitlines()]
    commands = list(dict.fromkeys(line.partition(" #")[0].rstrip() for line in shown if line.startswith("geokit ")))
    assert len(commands) >= 8
    for command in commands:
        _, verb, *words = shlex.split(command, comments=True)
        # All charts take as long as everything else here; tests/accuracy has them too.
        words += of_all(["--chart", "closest_point"], []) if verb == "bench" else []
        # tests/cli has a process for each verb.
        run = (run_geokit if verb == "info" else run_here)(verb, *words, cwd=folder)
        assert run.returncode == 0, f"{command}\n{run.stderr}"
    written = {path.name for path in folder.iterdir()} - FIRST
    assert written == {
        "torus.vdb",
        "torus.nvdb",
        "least.nvdb",
        "report",
        "thicker.vdb",
        "torus.obj",
        "distances.csv",
        "neighbors.npz",
        "figure.png",
        "scene.html",
    }


def test_set_up_commands_are_verbs_of_dev() -> None:
    shown = [
        line.split()[:2] for block in blocks(README, "sh") for line in block.splitlines() if line.startswith("./dev")
    ]
    assert shown == [["./dev", "demo"], ["./dev", "test"]]
    listed = subprocess.run([ROOT / "dev"], capture_output=True, text=True, check=True).stdout
    for verb in ("demo", "test", "check", "bench"):
        assert re.search(rf"^  {verb} ", listed, re.MULTILINE)
    unknown = subprocess.run([ROOT / "dev", "frobnicate"], capture_output=True, text=True)
    assert unknown.returncode == 1
    assert "no verb 'frobnicate'" in unknown.stderr


def test_ci_builds_the_site_and_runs_the_checks_and_the_tests() -> None:
    lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert lines[-3:] == ["./dev docs", "./dev check --changed", "exec ./dev test"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda page: page.stem
)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"
