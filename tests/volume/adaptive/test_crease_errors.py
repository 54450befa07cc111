"""Errors at creases of the distance: for each cell the largest, as one loop over points and cells finds it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import geokit as gk
from geokit.volume.adaptive import cells as module
from geokit.volume.adaptive.cells import BORDER, CREASE_DEPTHS, CellLattice, near_cells
from geokit.volume.tolerance.interpolation_errors import STENCILS, axis_weights
from tests.support.devices import DEVICES


def errors_by_loops(lattice, cells, limit, order):
    """The same from first principles: each point, each cell around it, one voxel after the other."""
    first, width = STENCILS[order]
    rows = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    errors = np.zeros(len(cells))
    for points, between in module._crease_points(lattice, limit, 1 << 20):
        for depth in CREASE_DEPTHS:
            asked = points + between * (depth * lattice.within)
            exact = (
                lattice.surface.signed_distance(asked, sign=lattice.sign).distance if depth else np.zeros(len(asked))
            )
            before = errors.copy()
            for u, d in zip((asked - lattice.origin) / lattice.size, exact, strict=True):
                if abs(d) > lattice.within * (1.0 + BORDER):
                    continue
                reach = [{int(np.floor(x - BORDER)), int(np.floor(x + BORDER))} for x in u]
                for cell in itertools.product(*reach):
                    row = rows.get(cell)
                    if row is None or (depth and before[row] > limit):
                        continue
                    at = np.stack(np.meshgrid(*[np.arange(width) + first] * 3, indexing="ij"), axis=-1) + cell
                    values = lattice.distances(at.reshape(-1, 3))[0].astype(np.float32).reshape(width, width, width)
                    weights = [axis_weights(order, np.array([x]))[0] for x in u - cell]
                    found = np.einsum("ijk,i,j,k", values.astype(np.float64), *weights)
                    errors[row] = max(errors[row], abs(found - d))
    return errors


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("share", [1e-3, 0.1])
def test_as_loops_find_them(order, share, device, monkeypatch):
    surface = gk.mesh.Surface(gk.mesh.box((1.0, 0.7, 0.4)), device=device)
    # The corner lies on a border of cells, others do not.
    lattice = CellLattice(surface, "pseudonormal", np.asarray(surface.bounds[0]) - 0.9, 0.3, 0.2)
    cells = np.random.default_rng(order).permutation(near_cells(lattice))
    found = {}
    monkeypatch.setattr(module, "CREASE_POINTS", 3)

    def kept(*given):
        found["creases"] = creases(*given)
        return found["creases"]

    creases = module._crease_errors
    monkeypatch.setattr(module, "_crease_errors", kept)
    module.examine(lattice, cells, share * lattice.size, order)
    expected = errors_by_loops(lattice, cells, share * lattice.size, order)
    assert (expected > 0.0).sum() > 5
    np.testing.assert_allclose(found["creases"], expected, rtol=1e-12, atol=1e-12)


def test_a_lattice_without_sharp_edges_has_errors_at_vertices_only():
    surface = gk.mesh.Surface(gk.mesh.sphere(segments=8), device="cpu")
    lattice = CellLattice(surface, "pseudonormal", np.full(3, -2.0), 0.1, 0.05)
    cells = near_cells(lattice)
    # No edge is as sharp as this limit asks for.
    errors = module.examine(lattice, cells, 10.0)
    assert (errors > 0.0).any()
    assert errors.max() < 0.1
