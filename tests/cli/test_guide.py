"""``geokit guide``."""

from __future__ import annotations

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
