"""``geokit view``."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

pytestmark = pytest.mark.slow


def test_a_page_of_several_files(geokit, cube: Path, cube_sdf: Path, tmp_path: Path) -> None:
    cloud, target = tmp_path / "cloud.csv", tmp_path / "page.html"
    gk.points.save(cloud, np.random.default_rng(0).random((50, 3)))
    done = geokit("view", cube, cube_sdf, cloud, "-o", target, "--title", "three", "--up", "z", "--colormap", "gray")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{target}: {target.stat().st_size} bytes\n"
    text = target.read_text(encoding="ascii")
    assert "<title>three</title>" in text
    assert re.findall(r'"kind": "(\w+)", "name": "([^"]+)"', text) == [
        ("mesh", cube.name), ("volume", cube_sdf.name), ("cloud", "cloud.csv"),
    ]  # fmt: skip
    assert '"up": "z"' in text
    assert '"colormap": "gray"' in text


def test_without_an_output_it_is_opened(geokit_process, cube: Path, tmp_path: Path) -> None:
    opener = tmp_path / "opener"
    opener.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/opened\n')
    opener.chmod(0o755)
    done = geokit_process("view", cube, BROWSER=str(opener), TMPDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    page = Path(done.stdout.partition(": ")[0])
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert (tmp_path / "opened").read_text().strip() == page.as_uri()


def test_refusals(geokit, fails, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    fails(geokit("view"), 2, "FILE")
    fails(geokit("view", "nowhere.obj", "-o", target), 1, "nowhere.obj", "no such file")
    fails(geokit("view", cube, "-o", tmp_path / "page.png"), 1, ".png", ".html")
    fails(geokit("view", cube, "-o", target, "--max-voxels", "5"), 1, "max_voxels")
    fails(geokit("view", cube, "-o", target, "--colormap", "no such map"), 1, "no such map")
    assert list(tmp_path.iterdir()) == []
    target.write_text("mine")
    fails(geokit("view", cube, "-o", target), 1, "page.html", "--force")
    assert target.read_text() == "mine"
