"""``geokit guide``."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


def test_the_list_then_one_guide(geokit, fails) -> None:
    listed = geokit("guide")
    assert listed.returncode == 0, listed.stderr
    head, *rows = listed.stdout.splitlines()
    assert head.split() == ["guide", "I", "have", "I", "want"]
    pages = (ROOT / "docs" / "guides").glob("*.md")
    assert sorted(row.split()[0] for row in rows) == sorted(page.stem for page in pages if page.stem != "index")
    for row in rows:
        printed = geokit("guide", row.split()[0])
        assert printed.returncode == 0, printed.stderr
        assert printed.stdout.startswith("# ")
        compile(printed.stdout, row, "exec")
    fails(geokit("guide", "ship"), 1, "there is no 'ship'")


def test_the_wheel_alone_has_what_guides_read(tmp_path: Path) -> None:
    """The folders of the wheel, laid out by hand: a program of `geokit guide` runs beside no checkout."""
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    # The second one is a wheel's alone.
    _, packed = re.findall(r"^wheel\.packages = \{(.*)\}$", settings, re.MULTILINE)
    for inside, source in re.findall(r'"([\w/]+)" = "([\w/]+)"', packed):
        left_out = shutil.ignore_patterns("__pycache__", "src", "generate.py")
        shutil.copytree(ROOT / source, tmp_path / "site" / inside, ignore=left_out, dirs_exist_ok=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    # An editable installation would put the checkout first: its hook is not loaded, and neither is any .pth.
    places = [str(tmp_path / "site"), *(path for path in sys.path if path.endswith("-packages"))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-S", *arguments], cwd=empty, env=environment, capture_output=True, text=True, timeout=600
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert Path(run("-c", "import geokit; print(geokit.__file__)").strip()).is_relative_to(tmp_path)
    (empty / "guide.py").write_text(run("-m", "geokit", "guide", "sdf-samples"), encoding="utf-8")
    run("guide.py")
    assert (empty / "sdf-samples.png").exists()
    names = {
        *re.findall(
            r"sample_path\(\"([\w.]+)\"\)",
            "".join(p.read_text("utf-8") for p in (ROOT / "docs" / "guides").glob("*.md")),
        )
    }
    assert {"torus.ply", "cloud.ply", "smoke.vdb"} <= names
    for name in names:
        assert (tmp_path / "site" / "geokit" / "samples" / name).exists(), name
