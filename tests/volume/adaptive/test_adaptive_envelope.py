"""Bytes of an adaptive field and of one voxel size, and whether ``plan`` knows the smaller: with and without detail."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.mesh import Surface
from geokit.volume import adaptive_from_mesh, from_mesh, plan
from tests.support.effort import of_all
from tests.volume.adaptive.test_adaptive_stability import ball_and_cube

pytestmark = pytest.mark.slow

# Checks of both are at different points, so a grid that passes one of them only just may fail the other.
EQUAL = 1.15


def both(mesh, share, **options):
    """Bytes of the adaptive field and of one voxel size, levels of the former, and the rows of a plan."""
    surface = Surface(mesh, device="cpu")
    tolerance = share * float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    levels = adaptive_from_mesh(surface, tolerance, **options)
    one = from_mesh(surface, tolerance=tolerance, **options)
    assert max(levels.achieved_error, one.info.achieved_error) <= tolerance
    rows = plan(surface, tolerance, **options)
    adaptive = [row for row in rows if row.method == "adaptive_from_mesh"]
    assert len(adaptive) == 1
    assert adaptive[0].level_count == levels.level_count
    assert adaptive[0].byte_count == pytest.approx(levels.byte_count, rel=0.25)
    single = next(row for row in rows if row.method == "from_mesh")
    assert single.byte_count == pytest.approx(one.info.byte_count, rel=0.25)
    assert (rows[0].method == "adaptive_from_mesh") == (adaptive[0].byte_count < 0.95 * single.byte_count)
    return levels, one.info.byte_count, rows


TORUS, BALL = mesh_catalog.torus(), mesh_catalog.icosphere(4)
OPEN = mesh_catalog.half_shell(mesh_catalog.icosphere())
PLATE = mesh_catalog.box((0, 0, 0), (1, 0.7, 0.01))
# A search among all orders and codecs takes three times as long, and tests/volume/tolerance has one.
FEW = {"order": 1, "codec": "fp8"}
CASES = {
    "plate-0.005-few": (PLATE, 5e-3, {"order": 2}),
    "open-0.02-few": (OPEN, 2e-2, FEW),
    **of_all(
        {},
        {
            # That of the largest ratio, 1.11.
            "plate-0.001": (PLATE, 1e-3, {}),
            "open-0.02": (OPEN, 2e-2, {}),
            "torus-0.01": (TORUS, 1e-2, {}),
            "torus-0.001": (TORUS, 1e-3, {}),
            "ball-0.01": (BALL, 1e-2, {}),
            "ball-0.001": (BALL, 1e-3, {}),
            "open-0.01": (OPEN, 1e-2, {}),
        },
    ),
}


@pytest.mark.parametrize(("mesh", "share", "options"), CASES.values(), ids=CASES)
def test_without_detail_it_takes_no_more_than_one_voxel_size(mesh, share, options):
    levels, one, rows = both(mesh, share, **options)
    assert levels.byte_count <= EQUAL * one
    if levels.level_count == 1:
        assert rows[0].method == "from_mesh"


@pytest.mark.parametrize(
    ("size", "share", "options"),
    [(0.1, 1e-3, {"order": 3, "codec": "fp16"}), *of_all([], [(0.05, 5e-4, {})])],
)
def test_with_detail_in_one_place_it_takes_clearly_less(size, share, options):
    levels, one, rows = both(ball_and_cube(size)[0], share, **options)
    assert levels.level_count > 1
    assert levels.byte_count < 0.6 * one
    assert rows[0].method == "adaptive_from_mesh"
    assert (rows[0].order, rows[0].level_count) == (levels.order, levels.level_count)
    assert rows[0].codec.split("+")[0] == levels.codecs[0]
    assert rows[0].voxel_size == pytest.approx(levels.voxel_sizes[0])


def test_a_plan_of_what_has_no_levels_has_no_row_for_them():
    box = mesh_catalog.box()
    for options in ({"thickness": 0.1}, {"half_width": 3.0}, {"sign": "none"}):
        assert {row.method for row in plan(box, 0.1, order=1, codec="float", device="cpu", **options)} == {"from_mesh"}
