"""Fields of open and damaged meshes at all resolutions and widths: signs, and the surface that they show."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from tests.support.effort import of_all
from tests.volume.band.test_sign_change_tiles import OPEN, require_no_second_surface, require_signs, turned

pytestmark = pytest.mark.filterwarnings("ignore:.* of its pieces are too thin:UserWarning")

# Each as it is or turned.
BOTH = of_all([turned(m) if k % 2 else m for k, m in enumerate(OPEN)], [*OPEN, *map(turned, OPEN)])
# A plane sheet has no inside, and shows nothing.
CURVED = [mesh for mesh in OPEN if mesh.name != "sheet"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("across", "half_width"),
    of_all(
        [(7.0, 1.0), (30.3, (4.0, 1.5))],
        [(7.0, 1.0), (40.3, (4.0, 1.5)), (90.7, 1.0), (24.0, (1.5, 4.0)), (64.0, 3.0)],
    ),
)
@pytest.mark.parametrize("mesh", BOTH, ids=lambda mesh: mesh.name)
def test_every_resolution_and_width(mesh, across, half_width):
    require_signs(mesh, float(np.ptp(mesh.bounds, axis=0).max()) / across, half_width=half_width)


@pytest.mark.slow
@pytest.mark.parametrize("name", mesh_catalog.BROKEN)
@pytest.mark.parametrize(
    "mesh",
    of_all([mesh_catalog.torus()], [mesh_catalog.icosphere(3), mesh_catalog.torus()]),
    ids=lambda mesh: mesh.name,
)
def test_damaged_meshes(mesh, name):
    damaged = mesh_catalog.BROKEN[name](mesh)
    require_signs(damaged, float(np.ptp(damaged.bounds, axis=0).max()) / of_all(45.3, 70.3), half_width=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["marching_cubes", "surface_nets"])
@pytest.mark.parametrize("across", of_all([20], [20, 50, 110]))
@pytest.mark.parametrize("mesh", [mesh for mesh in BOTH if not mesh.name.startswith("sheet")], ids=lambda m: m.name)
def test_no_open_mesh_has_a_second_surface(mesh, across, method):
    require_no_second_surface(mesh, float(np.ptp(mesh.bounds, axis=0).max()) / across, method)
