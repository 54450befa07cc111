"""What the README shows is run: its Python, its commands, its two set-up commands' verbs, its links."""

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
README = (ROOT / "README.md").read_text(encoding="utf-8")

FIRST = {"torus.png", "torus.ply", "cloud.ply"}


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An otherwise empty folder with what the first program leaves: it and the commands need no checkout."""
    (first,) = blocks("py")
    run = subprocess.run([sys.executable, "-c", first], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert {path.name for path in tmp_path.iterdir()} == FIRST
    return tmp_path


@pytest.mark.slow
def test_python(folder: Path) -> None:
    # The example of the first screen (py) and the tour (python).
    first, tour = blocks("py"), blocks("python")
    assert (len(first), len(tour)) == (1, 1)
    code = "\n".join(first + tour)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines() == ["True"]
    assert {path.name for path in folder.iterdir()} == {*FIRST, "torus.vdb", "closest.vtp", "scene.html"}


@pytest.mark.slow
def test_commands(folder: Path) -> None:
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("geokit ")]
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
    shown = [line.split()[:2] for block in blocks("sh") for line in block.splitlines() if line.startswith("./dev")]
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
