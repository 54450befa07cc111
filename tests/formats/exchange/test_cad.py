"""Parts of CAD programs: closed, within the stated distance of the true faces, in millimeters."""

from __future__ import annotations

import re

import numpy as np
import pytest

import geokit as gk
from geokit.formats.table import FORMATS
from tests.support.exchange_files import write_cad

pytest.importorskip("OCP", reason="needs cadquery-ocp-novtk")

pytestmark = pytest.mark.slow

KINDS = [kind for kind, row in FORMATS.items() if row.extra == "cad"]


@pytest.mark.parametrize("kind", KINDS)
def test_solids_are_closed_and_within_the_stated_distance(kind, tmp_path):
    write_cad(tmp_path / f"a{kind}")
    mesh = gk.mesh.load(tmp_path / f"a{kind}")
    assert mesh.meters_per_unit == 1e-3
    audit = gk.mesh.audit(mesh)
    assert audit.watertight
    assert audit.oriented
    assert not audit.inside_out
    assert audit.component_count == 2
    triangles = mesh.vertices[mesh.faces]
    allowed = 1e-4 * audit.diagonal
    # Samples of each triangle, of which those of the mantle lie inside the cylinder by no more than allowed.
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 40)
    samples = np.einsum("sk,tkd->tsd", weights, triangles).reshape(-1, 3)
    x, y, z = samples.T
    radius = np.hypot(x, y)
    mantle = 1.0 - radius
    caps = np.minimum(np.abs(z), np.abs(z - 3.0))
    cube = np.abs(np.abs(samples - [6.0, 1.0, 1.0]).max(axis=1) - 1.0)
    off = np.where(x > 3.0, cube, np.minimum(np.abs(mantle), np.where(radius < 1.0 + 1e-12, caps, np.inf)))
    assert off.max() <= allowed
    assert audit.signed_volume == pytest.approx(3 * np.pi + 8, rel=1e-3)


def test_units_become_millimeters(tmp_path):
    write_cad(tmp_path / "a.step", unit="INCH")
    assert "INCH" in (tmp_path / "a.step").read_text()
    low, high = gk.mesh.audit(gk.mesh.load(tmp_path / "a.step")).bounds
    np.testing.assert_allclose(high[0] - low[0], 8.0, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_parts_are_refused_with_their_path(kind, tmp_path):
    path = tmp_path / f"a{kind}"
    write_cad(path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 3], b"no part\n" * 20):
        path.write_bytes(content)
        with pytest.raises(gk.FileFormatError, match=f"^{re.escape(str(path))}: "):
            gk.mesh.load(path)


def test_a_face_that_cannot_be_made_is_said(tmp_path):
    path = tmp_path / "a.step"
    write_cad(path)
    text = path.read_text()
    path.write_text(re.sub(r"CYLINDRICAL_SURFACE\(", "CYLINDRICAL_SURFICE(", text))
    with pytest.warns(UserWarning, match="1 of its faces are not read"):
        assert gk.mesh.audit(gk.mesh.load(path)).boundary_edge_count > 0


@pytest.mark.parametrize("kind", [".step", ".iges"])
def test_a_tolerance_decides_how_many_triangles_there_are(kind, tmp_path):
    path = tmp_path / f"a{kind}"
    write_cad(path)
    counts = []
    for tolerance in (0.1, 1e-3, 1e-4):
        mesh = gk.mesh.load(path, tolerance=tolerance)
        counts.append(mesh.face_count)
        middles = mesh.vertices[mesh.faces].mean(axis=1)
        radius = np.hypot(*middles[:, :2].T)
        # Triangles of the mantle: the caps lie at 0 and 3, the cube beyond 3.
        mantle = (middles[:, 0] < 3.0) & (middles[:, 2] > 1e-9) & (middles[:, 2] < 3.0 - 1e-9)
        assert mantle.any()
        assert np.abs(radius[mantle] - 1.0).max() <= tolerance
    assert counts[0] < counts[1] < counts[2]
    trusted = gk.mesh.load(path, tolerance=0.1, trusted=True)
    assert trusted.face_count == counts[0]


# Open CASCADE's own estimate is short for these.
@pytest.mark.parametrize("kind", [".step", ".iges"])
@pytest.mark.parametrize("tolerance", [None, 0.2, 0.01])
def test_doubly_curved_faces_are_within_the_tolerance_too(kind, tolerance, tmp_path):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeSphere, BRepPrimAPI_MakeTorus

    shapes = {
        BRepPrimAPI_MakeSphere(7.0): lambda p: np.linalg.norm(p, axis=1) - 7.0,
        BRepPrimAPI_MakeTorus(20.0, 5.0): lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - 20.0, p[:, 2]) - 5.0,
    }
    for shape, distance in shapes.items():
        write_cad(tmp_path / f"a{kind}", shape.Shape())
        mesh = gk.mesh.load(tmp_path / f"a{kind}", tolerance=tolerance)
        samples = gk.mesh.sample_surface(mesh, 100_000).points
        assert np.abs(distance(samples)).max() <= (tolerance or 1e-4 * mesh.diagonal)


@pytest.mark.filterwarnings("ignore:.*does not hold the unit")
def test_the_command_line_takes_the_tolerance(tmp_path, capsys):
    from geokit.cli import main

    write_cad(tmp_path / "a.step")
    for name, more in (("a", []), ("b", ["--cad-tolerance", "0.1"])):
        assert main(["convert", str(tmp_path / "a.step"), str(tmp_path / f"{name}.ply"), *more]) == 0
    fine, coarse = (gk.mesh.load(tmp_path / f"{name}.ply").face_count for name in "ab")
    assert coarse < fine
    assert main(["info", str(tmp_path / "a.step"), "--cad-tolerance", "-1"]) == 1
    assert "cad_tolerance" in capsys.readouterr().err
