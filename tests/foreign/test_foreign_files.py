"""Files of other programs are read as they were meant, value by value; `./dev foreign` makes all of them anew."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from geokit import native
from geokit.formats.table import FORMATS
from tests.foreign import compare
from tests.foreign.table import KEPT, ONE_WRITER, OUTSIDE, PACKAGES, ROWS, Row

# Extensions that are other names of a format.
SAME = {".stp": ".step", ".igs": ".iges"}


def test_every_format_has_files_of_two_programs() -> None:
    writers: dict[str, set[str]] = {}
    for row in ROWS:
        writers.setdefault(SAME.get(row.kind, row.kind), set()).add(row.writer)
    few = {kind for kind in FORMATS if kind not in SAME and len(writers.get(kind, ())) < 2}
    assert few == ONE_WRITER.keys()


def test_every_file_has_a_name_and_what_is_kept_is_in_the_table() -> None:
    assert len({row.id for row in ROWS}) == len(ROWS)
    assert {row.writer for row in ROWS} == PACKAGES.keys() >= OUTSIDE
    kept = {folder.name for folder in KEPT.iterdir() if folder.is_dir()}
    assert kept == {row.id for row in ROWS if row.writer in OUTSIDE and not row.large}
    assert sum(path.stat().st_size for path in KEPT.rglob("*") if path.is_file()) < 300_000


@pytest.mark.slow
@pytest.mark.parametrize("row", [row for row in ROWS if not row.large], ids=lambda row: row.id)
def test_it_is_read_as_it_was_meant(row: Row, tmp_path: Path) -> None:
    if row.kind == ".vdb" and not native.available():
        pytest.skip("geokit was built without OpenVDB")
    if FORMATS[row.kind].extra == "cad":
        pytest.importorskip("OCP")
    folder = KEPT / row.id
    if row.writer not in OUTSIDE:
        if not row.is_here:
            pytest.skip(f"{row.writer} is not installed")
        folder = tmp_path
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the writers warn of is their own
            row.make(folder / f"a{row.kind}")
    assert compare.faults(row, folder) == []


@pytest.mark.parametrize(
    ("id", "name", "change"),
    [
        ("numpy-stl.stl", "VERTICES", 2.0**-20),
        ("polars.csv", "CLOUD", 2.0**-30),
        ("simpleitk.mha", "IMAGE", 1),
        ("simpleitk.nii", "ORIGIN", 2.0),
        ("lagrange.vdb", "VALUES", 2.0**-20),
        ("lagrange.nvdb", "INDICES", 1),
    ],
)
def test_a_wrong_number_is_a_fault(id: str, name: str, change: float, monkeypatch: pytest.MonkeyPatch) -> None:
    if id.endswith(".vdb") and not native.available():
        pytest.skip("geokit was built without OpenVDB")
    (row,) = (row for row in ROWS if row.id == id)
    changed = getattr(compare, name).copy()
    changed[-1] += change
    monkeypatch.setattr(compare, name, changed)
    assert compare.faults(row, KEPT / id)


@pytest.mark.parametrize("id", ["plyfile.ply", "pypcd4.pcd"])
def test_a_wrong_array_is_a_fault(id: str) -> None:
    (row,) = (row for row in ROWS if row.id == id)
    for name, values in row.data.items():
        changed = values.copy()
        changed[-1] += 1
        assert len(compare.faults(row._replace(data={name: changed}), KEPT / id)) == 1
        assert compare.faults(row._replace(data={f"{name}_": values}), KEPT / id)


def test_a_warning_is_a_fault() -> None:
    """Of what is left out, unless the row says so."""
    (row,) = (row for row in ROWS if row.id == "assimp.3mf")
    assert compare.faults(row, KEPT / row.id) == []
    (fault,) = compare.faults(row._replace(limit=""), KEPT / row.id)
    assert fault.startswith("warned: ")
