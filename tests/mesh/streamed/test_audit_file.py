"""The audit of a file part by part is that of the mesh in memory; what cannot be read is named."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog as catalog
from geokit import FileAccessError, FileFormatError, InputError
from geokit.mesh import MeshAudit, TriangleMesh
from geokit.mesh.streamed import audit_file
from tests.support.effort import of_all, spread

MESHES = [
    catalog.single_triangle(),
    catalog.torus(),
    catalog.inside_out_box(),
    catalog.nested_boxes(),
    catalog.two_boxes_touching_at_a_vertex(),
    catalog.open_shell(),
    catalog.crossing_sheets(),
    catalog.sliver_fan(),
    catalog.duplicate_faces(),
    catalog.flipped_faces(),
    catalog.zero_area_triangles(),
    catalog.collapsed_faces(),
    catalog.three_on_an_edge(),
    catalog.bowtie(),
    catalog.unreferenced_vertices(),
    catalog.far_away(catalog.torus()),
    catalog.doubled(catalog.torus()),
    catalog.with_duplicates(catalog.torus()),
    catalog.with_fins(catalog.torus()),
    catalog.overlapping_copies(catalog.icosphere(2)),
]


@pytest.fixture
def in_parts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """As many parts as the sample allows; the numbers of those that were made."""
    made: list[int] = []
    add = audit_file._Sums.add
    monkeypatch.setattr(audit_file._Sums, "add", lambda self, tile: made.append(tile) or add(self, tile))
    monkeypatch.setattr(audit_file, "BYTES_PER_TRIANGLE", 1 << 40)
    return made


def same(found: MeshAudit, path: Path) -> None:
    mesh = gk.mesh.load(path)
    expected = gk.mesh.audit(mesh)
    used = mesh.vertices[np.unique(mesh.faces)] + 0.0
    expected = dataclasses.replace(
        expected, vertex_count=len(np.unique(used, axis=0)), coincident_count=0, unreferenced_count=0
    )
    for field in dataclasses.fields(MeshAudit):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if field.name in ("area", "signed_volume"):
            scale = expected.area * max(expected.diagonal, 1.0)
            assert one == pytest.approx(other, rel=1e-12, abs=1e-12 * scale), field.name
        else:
            np.testing.assert_array_equal(one, other, field.name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "kind"),
    of_all(
        list(zip(spread(range(len(MESHES)), 8), itertools.cycle([".stl", ".ply"]), strict=False)),
        list(itertools.product(range(len(MESHES)), [".stl", ".ply"])),
    ),
)
def test_the_audit_is_that_in_memory(at: int, kind: str, in_parts: list[int], tmp_path: Path) -> None:
    mesh, path = MESHES[at], tmp_path / f"a{kind}"
    gk.mesh.save(path, mesh)
    same(gk.mesh.audit_file(path), path)
    assert len(in_parts) >= mesh.face_count / 16
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_so_it_is_in_one_part(tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "a.ply", catalog.with_fins(catalog.torus()))
    same(gk.mesh.audit_file(tmp_path / "a.ply"), tmp_path / "a.ply")


@pytest.mark.slow
@pytest.mark.usefixtures("in_parts")
@settings(max_examples=of_all(15, 60), deadline=None)
@given(seed=st.integers(0, 2**32 - 1), side=st.integers(1, 5), count=st.integers(1, 400))
def test_soups_on_a_lattice(seed: int, side: int, count: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Corners that coincide everywhere: edges and faces of any number, fans of any kind, many components."""
    rng = np.random.default_rng(seed)
    near = rng.integers(0, 40, (count, 1, 3)) * (rng.random((count, 1, 1)) < 0.5)
    corners = (near + rng.integers(-side, side, (count, 3, 3), endpoint=True)).astype(float)
    path = tmp_path_factory.mktemp("soup") / "a.ply"
    gk.mesh.save(path, TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)))
    same(gk.mesh.audit_file(path), path)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 1000])
def test_order_statistics(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_file, "NUMBERS_AT_A_TIME", 77)
    rng = np.random.default_rng(count)
    numbers = np.exp(rng.normal(size=count) * rng.choice([0.0, 1e-15, 50.0], count))
    numbers[rng.random(count) < 0.2] = np.inf
    numbers[rng.random(count) < 0.2] = 0.0
    file = audit_file.OrderStatistics(tmp_path / "a")
    for first in range(0, count, 300):
        file.add(numbers[first : first + 300])
    np.testing.assert_array_equal(file.at(range(count)), np.sort(numbers))


def test_progress_and_no_faces(tmp_path: Path) -> None:
    done: list[int] = []
    gk.mesh.save(tmp_path / "a.stl", catalog.torus())
    gk.mesh.audit_file(tmp_path / "a.stl", progress=lambda at, of: done.append(at))
    assert done == sorted(done)
    assert done[-1] == 100
    (tmp_path / "b.stl").write_bytes(bytes(84))
    found = gk.mesh.audit_file(tmp_path / "b.stl")
    assert found.face_count == 0
    assert not found.watertight


def test_what_cannot_be_read_or_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = tmp_path / "a.ply"
    gk.mesh.save(good, catalog.torus())

    def refused(kind: type[Exception], text: str, path: Path = good, **how: Any) -> None:
        with pytest.raises(kind, match=text):
            gk.mesh.audit_file(path, **how)

    refused(FileAccessError, "no such file", tmp_path / "b.ply")
    refused(InputError, "is not a binary mesh format", tmp_path / "b.obj")
    refused(InputError, "memory_limit", memory_limit=1000)
    refused(FileAccessError, "cannot write there", folder=tmp_path / "none")
    whole = good.read_bytes()
    (tmp_path / "c.ply").write_bytes(whole[:-5])
    refused(FileFormatError, r"c\.ply", tmp_path / "c.ply")
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("usage", (), {"free": 1000}))
    refused(FileAccessError, "the temporary files of its audit need")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "c.ply"]
