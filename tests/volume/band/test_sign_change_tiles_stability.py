"""Fields of a sphere with a hole, from a pinprick to a half and beyond: signs, and the surface that they show."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from tests.support.effort import of_all
from tests.volume.band.test_sign_change_tiles import require_no_second_surface, require_signs

# Share of the angle that is covered, and the largest share of the isosurface's vertices that lie in the hole, farther
# than 1.5 voxels from the mesh, at 60 voxels across.
SWEEP = [(0.999, 0.0), (0.99, 0.0), (0.98, 1e-3), (0.95, 0.01), (0.9, 0.01), (0.75, 0.02), (0.5, 0.07), (0.3, 0.11)]


@pytest.mark.parametrize(("share", "most"), of_all([SWEEP[0], SWEEP[3], SWEEP[6], SWEEP[7]], SWEEP))
def test_holes_of_all_sizes(share, most):
    mesh = mesh_catalog.spherical_cap(share, 96, 48)
    grid = require_signs(mesh, 2 / 60.7)
    found, to_rim = require_no_second_surface(mesh, 2 / 60.7, "surface_nets")
    assert found <= most
    if share >= 0.5:
        assert to_rim <= 4.0
        # The volume is that of the body that the hole's plane closes.
        height = 1 - np.cos(np.pi * share)
        expected = np.pi * height**2 * (3 - height) / 3
        axis = np.arange(-32, 33) * 2 / 60.7
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = (grid.sample(points, order=0, device="cpu") < 0).sum() * (2 / 60.7) ** 3
        assert inside == pytest.approx(expected, rel=0.02)
