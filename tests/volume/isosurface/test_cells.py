"""What a GPU does in another way than a CPU gives the same: signs by rows, planes one by one."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import sphere
from geokit.core import launcher
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.isosurface import launch, nodes
from geokit.volume.isosurface.cells import crossed_cells


@pytest.mark.parametrize("isovalue", [0.0, 0.1, -2.9999999, 1e300, -1e300])
def test_signs_by_rows_are_those_by_leaves(isovalue):
    from geokit.volume.isosurface.cells_kernels import row_sides_kernel

    device = launcher.resolve_device("cpu")
    volume = sphere(11.3)
    found = crossed_cells(volume, isovalue, device)
    by_leaves = found.cells.sides.numpy().copy()
    limit = np.float32(min(max(isovalue, -3e38), 3e38))
    if float(limit) < isovalue < 3e38:
        limit = np.nextafter(limit, np.float32(np.inf))
    found.cells.sides.zero_()
    launcher.launch(row_sides_kernel, 64 * found.cells.leaf_count, [found.cells, limit], [], device)
    np.testing.assert_array_equal(found.cells.sides.numpy(), by_leaves)
    # And they are what the definition says.
    tree = found.cells
    values = np.ndarray((tree.leaf_count, 512), "<f4", volume.nanovdb, _first_value(volume), (2144, 4))
    bits = np.unpackbits(by_leaves.view(np.uint8), bitorder="little").reshape(-1, 512)
    np.testing.assert_array_equal(bits, values.astype(np.float64) < isovalue)


def _first_value(volume):
    from geokit.volume.nanovdb.header import TREE_OFFSET, tree_header

    return TREE_OFFSET + int(tree_header(volume.nanovdb)["node_offset"][0]) + 96


@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes", "dual_contouring"])
def test_planes_one_by_one(method, monkeypatch):
    volume = sphere(11.3)
    expected = from_volume(volume, method=method, device="cpu")

    def one_by_one(kernel, planes, inputs, outputs, device):
        launcher.launch(kernel, planes, [1, *inputs], outputs, device)

    monkeypatch.setattr("geokit.volume.isosurface.surface_nets.launch_planes", one_by_one)
    found = from_volume(volume, method=method, device="cpu")
    assert launch.PLANES == 8
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)


@pytest.mark.slow
def test_a_tree_is_looked_up_once_and_forgotten_with_its_volume(monkeypatch):
    volume, found = sphere(5.0), []
    find = nodes._find_topology

    def counted(buffer):
        found.append(find(buffer))
        return found[-1]

    monkeypatch.setattr(nodes, "_find_topology", counted)
    from_volume(volume, device="cpu")
    from_volume(volume, isovalue=0.5, device="cpu")
    assert len(found) == 1
    topology = weakref.ref(found.pop())
    assert topology() is not None
    del volume
    gc.collect()
    assert topology() is None
