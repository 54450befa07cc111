"""Every example runs, from another folder, and leaves what it says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from geokit import native

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name: str, *arguments: object, cwd: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
def test_volumes(tmp_path: Path) -> None:
    from matplotlib import image

    said = run("volumes.py", "--resolution", 48, "--pixels", 64, "--out", "tour.png", cwd=tmp_path)
    assert "watertight True" in said
    picture = image.imread(tmp_path / "tour.png")
    assert picture.shape[2] == 4
    assert picture[..., :3].std() > 0.1
