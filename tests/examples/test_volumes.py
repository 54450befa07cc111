"""Every example runs, from another folder, and leaves what it says."""

from __future__ import annotations

from pathlib import Path

import pytest

from geokit import native
from tests.support.scripts import EXAMPLES, run_script

pytestmark = pytest.mark.slow


def run(name: str, *arguments: object, cwd: Path) -> str:
    return run_script(EXAMPLES / name, *arguments, folder=cwd)


@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
def test_volumes(tmp_path: Path) -> None:
    from matplotlib import image

    said = run("volumes.py", "--resolution", 48, "--pixels", 64, "--out", "tour.png", cwd=tmp_path)
    assert "watertight True" in said
    picture = image.imread(tmp_path / "tour.png")
    assert picture.shape[2] == 4
    assert picture[..., :3].std() > 0.1
