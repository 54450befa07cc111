"""The notebooks: what their guides say, small, without outputs; and they run in Jupyter."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from geokit import native
from tests.house.test_guides import module
from tests.house.test_site import DOCS, ROOT, blocks, text_of
from tests.support.effort import of_all

MADE = module(DOCS / "notebooks.py")
LARGEST = 20_000


@pytest.mark.parametrize("name", MADE.NAMES)
def test_a_notebook_is_its_guide(name: str) -> None:
    path, page = DOCS / "notebooks" / f"{name}.ipynb", DOCS / "guides" / f"{name}.md"
    assert path.read_text(encoding="utf-8") == MADE.notebook(text_of(page)), "run python docs/notebooks.py"
    assert path.stat().st_size < LARGEST
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert [block.rstrip("\n") for block in blocks(page)] == [text for text in code[1:] if "Shown(" not in text]
    assert not any(cell.get("outputs") for cell in cells)
    for cell in cells:
        for link in MADE.re.findall(r"\]\((?!http)([^)#]+)", "".join(cell["source"])):
            assert (path.parent / link).exists(), link


def test_there_are_no_others_and_the_site_names_them() -> None:
    assert {path.stem for path in (DOCS / "notebooks").iterdir()} == set(MADE.NAMES)
    for name in MADE.NAMES:
        assert f"(../notebooks/{name}.ipynb)" in text_of(DOCS / "guides" / "index.md")


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
# Their code is that of the guides, which run too.
@pytest.mark.parametrize("name", of_all(["compare-scans"], MADE.NAMES))
def test_a_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where the notebook makes its folder
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    path = DOCS / "notebooks" / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(path.parent)}})
    done = client.execute()
    shown = [out for cell in done.cells for out in cell.get("outputs", []) if out.output_type == "display_data"]
    shown += [out for cell in done.cells for out in cell.get("outputs", []) if out.output_type == "execute_result"]
    pictures = [out for out in shown if any(kind.startswith("image/") for kind in out.data)]
    assert len(pictures) == text_of(DOCS / "guides" / f"{name}.md").count("\n![")
