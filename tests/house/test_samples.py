"""The sample files are what their README says, and what their script makes."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

FOLDER = Path(__file__).parents[2] / "data" / "samples"


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(FOLDER / "generate.py"))


@pytest.mark.parametrize(("file", "function"), [("torus.ply", "torus"), ("bracket.obj", "bracket")])
def test_script_makes_the_files(script, file, function):
    mesh, made = gk.mesh.load(FOLDER / file), script[function]()
    # Other processors' sines may differ in the last bit.
    np.testing.assert_allclose(mesh.vertices, made.vertices, rtol=0, atol=1e-14 * made.diagonal)
    np.testing.assert_array_equal(mesh.faces, made.faces)


def test_torus(script):
    mesh = gk.mesh.load(FOLDER / "torus.ply")
    report = gk.mesh.audit(mesh)
    assert (report.vertex_count, report.face_count, report.euler_number) == (12800, 25600, 0)
    assert report.watertight
    assert report.oriented
    assert not report.inside_out
    assert np.abs(script["torus_distance"](mesh.vertices)).max() < 1e-15
    corners = mesh.vertices[mesh.faces]
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 20)
    inside = np.einsum("wc,fck->wfk", weights, corners).reshape(-1, 3)
    assert np.abs(script["torus_distance"](inside)).max() < 6e-4


def test_bracket():
    report = gk.mesh.audit(gk.mesh.load(FOLDER / "bracket.obj"))
    assert report.watertight
    assert report.oriented
    assert report.manifold
    assert report.euler_number == 0
    hole = 0.5 * 32 * 36 * np.sin(2 * np.pi / 32)
    side = 2 * 6 * np.sin(np.pi / 32)
    assert report.signed_volume == pytest.approx(40 * 30 * 4 + 4 * 30 * 26 - 4 * hole, rel=1e-12)
    plane = 40 * 30 + 36 * 30 + 4 * 30 + 26 * 30 + 30 * 30 + 4 * 30 + 2 * (40 * 4 + 4 * 26)
    assert report.area == pytest.approx(plane - 2 * hole + 32 * side * 4, rel=1e-12)


def test_shell():
    report = gk.mesh.audit(gk.mesh.load(FOLDER / "shell.stl"))
    assert (report.vertex_count, report.face_count) == (3841, 7584)
    assert (report.boundary_edge_count, report.component_count, report.euler_number) == (96, 1, 1)
    assert report.manifold
    assert report.oriented


def test_broken():
    report = gk.mesh.audit(gk.mesh.load(FOLDER / "broken.obj"))
    assert (report.degenerate_count, report.duplicate_count, report.unreferenced_count) == (12, 15, 5)
    assert report.boundary_edge_count > 0
    assert report.non_manifold_edge_count > 0
    assert not report.oriented
    assert not report.watertight


def test_cloud(script):
    data = (FOLDER / "cloud.ply").read_bytes()
    table = np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4").reshape(-1, 6).astype(np.float64)
    assert len(table) == 20_000
    np.testing.assert_allclose(np.linalg.norm(table[:, 3:], axis=1), 1, atol=1e-6)
    distance = script["torus_distance"](table[:, :3])
    assert np.std(distance) == pytest.approx(0.002, rel=0.05)
    # Along the normal the distance grows by as much.
    step = script["torus_distance"](table[:, :3] + 0.01 * table[:, 3:]) - distance
    np.testing.assert_allclose(step, 0.01, atol=1e-6)
    with pytest.raises(gk.FileFormatError, match="holds 20000 points but no faces"):
        gk.mesh.load(FOLDER / "cloud.ply")


def test_volumes(script):
    from geokit import native

    if not native.available():
        pytest.skip("needs the OpenVDB extension")
    torus, grids = gk.volume.load(FOLDER / "torus.vdb"), gk.volume.load_all(FOLDER / "smoke.vdb")
    assert (torus.info.name, torus.info.grid_class, torus.info.grid_type) == ("torus", "level set", "float")
    assert {name: grid.info.grid_type for name, grid in grids.items()} == {"density": "float", "velocity": "vec3f"}
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (20_000, 3))
    exact = script["torus_distance"](points)
    near = np.abs(exact) < 0.06
    # The mesh's 6e-4, and a trilinear error of a twelfth of a voxel at this curvature.
    assert np.abs(torus.sample(points[near]) - exact[near]).max() < 2e-3
    density, velocity = script["smoke"]()
    active = int(np.count_nonzero(density))
    assert [grid.info.active_voxel_count for grid in grids.values()] == [active, active]
    index = np.argwhere(density > 0)[:: max(1, active // 500)]
    world = (index - [32, 32, 0]) * script["SMOKE_VOXEL"]
    # Files hold 16 bits: 11 digits of precision.
    np.testing.assert_allclose(grids["density"].sample(world, order=0), density[tuple(index.T)], rtol=5e-4)
    np.testing.assert_allclose(grids["velocity"].sample(world, order=0), velocity[tuple(index.T)], rtol=5e-4, atol=1e-6)


def test_samples_stay_small():
    assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < 4_000_000
