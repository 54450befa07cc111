"""All repairs in one call: what was sound stays, what was damaged is mended or said."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog as catalog
from geokit.errors import InputError
from geokit.mesh import TriangleMesh, audit, repair


@pytest.mark.parametrize("make", catalog.CLOSED, ids=lambda make: make.__name__)
def test_what_is_sound_stays(make):
    mesh = make()
    found = repair(mesh)
    assert np.array_equal(found.mesh.vertices[found.mesh.faces], mesh.vertices[mesh.faces])
    assert (found.dropped, found.flipped, len(found.holes.width)) == (0, 0, 0)


def test_the_broken_sample_becomes_a_solid():
    found = repair(gk.mesh.load(gk.sample_path("broken.obj")))
    report = audit(found.mesh, self_intersections=True)
    assert report.watertight
    assert report.manifold
    assert report.self_intersection_count == 0
    # 15 copies, 12 collapsed faces, 8 slivers; 20 flipped, 10 missing.
    assert (found.dropped, found.flipped, int(found.holes.filled.sum())) == (35, 20, 10)


@pytest.mark.parametrize("seed", range(4))
def test_damage_of_all_kinds_at_once(seed):
    whole = catalog.icosphere(3)
    mesh = catalog.with_fins(catalog.with_duplicates(catalog.with_flips(whole, 0.05, seed), 0.05, seed), 0.05, seed)
    rng = np.random.default_rng(seed)
    gone = rng.permutation(whole.face_count)[:12]
    missing = [set(whole.faces[row]) for row in gone]
    mesh = TriangleMesh(mesh.vertices, [face for face in mesh.faces if set(face) not in missing])
    found = repair(catalog.soup(mesh))
    report = audit(found.mesh, self_intersections=True)
    assert (report.boundary_edge_count, report.non_manifold_edge_count, report.self_intersection_count) == (0, 0, 0)
    assert found.mesh.volume == pytest.approx(whole.volume, rel=0.02)
    assert found.merged > 0


def test_three_faces_on_an_edge_stay():
    for make in (catalog.three_on_an_edge, catalog.bowtie):
        found = repair(make())
        assert found.dropped == 0
        assert found.mesh.face_count >= make().face_count


def test_sheets_back_to_back_stay():
    pair = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [2, 1, 0]])
    assert repair(pair).mesh.face_count == 2


def test_tolerance_and_width_are_those_of_the_parts():
    box = catalog.soup(catalog.box())
    moves = 1e-5 * np.random.default_rng(0).uniform(-1, 1, box.vertices.shape)
    torn = TriangleMesh(box.vertices + moves, box.faces[1:])
    assert repair(torn, tolerance=1e-4).holes.filled.tolist() == [True]
    assert audit(repair(torn, tolerance=1e-4).mesh).watertight
    assert repair(torn, tolerance=1e-4, max_width=0.5).holes.filled.tolist() == [False]
    for name in ("tolerance", "max_width"):
        with pytest.raises(InputError, match=name):
            repair(torn, **{name: -1.0})


def test_an_empty_mesh_is_taken():
    found = repair(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    assert found.mesh.face_count == 0
