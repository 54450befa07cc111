"""Surfaces at active tiles of 128^3 and 4096^3 voxels: found where values differ, refused if they cannot be counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import geokit as gk
from geokit.errors import DeviceMemoryError
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.isosurface.nodes import topology_of
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree import estimates
from geokit.volume.tree.typed_tree import Nodes, tree_of_leaves
from geokit.volume.tree.typed_writer import rebuilt
from tests.support.lying_grids import SOURCES, lying

METHODS = ("surface_nets", "marching_cubes", "dual_contouring")


def tiled(values: dict[tuple[int, int, int], float], inactive: dict[tuple[int, int, int], float] | None = None):
    """A float grid of background 1 whose only upper node has tiles of 128^3 voxels by place."""
    like = gk.volume.from_dense(np.zeros((2, 2, 2), np.float32), voxel_size=1.0)
    none = np.empty((0, 3), np.int32), np.empty((0, 64), np.uint8), np.empty((0, 512), np.float32)
    tree = tree_of_leaves(LAYOUTS["float"], np.float32(1.0).reshape(()), *none)
    held, on = np.ones((1, 32**3), np.float32), np.zeros((1, 32**3), np.bool_)
    for some, state in ((values, True), (inactive or {}, False)):
        for (x, y, z), value in some.items():
            slot = (x * 32 + y) * 32 + z
            held[0, slot], on[0, slot] = value, state
    return rebuilt(replace(tree, upper=Nodes(np.zeros((1, 3), np.int32), held, on)), like)


@pytest.mark.parametrize("method", METHODS)
def test_two_tiles_inside(method):
    mesh = from_volume(tiled({(3, 3, 3): -1.0, (3, 3, 4): -1.0}), method=method, device="cpu")
    audit = gk.mesh.audit(mesh)
    assert audit.watertight
    assert audit.component_count == 1
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    np.testing.assert_allclose(low, [383.5] * 3, atol=0.51)
    np.testing.assert_allclose(high, [511.5, 511.5, 639.5], atol=0.51)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")
def test_a_crossing_between_inactive_voxels_gives_no_face(method):
    # The inactive tile touches the active one at an edge only.
    assert from_volume(tiled({(3, 3, 3): 1.0}, {(4, 4, 3): -1.0}), method=method, device="cpu").face_count == 0


def test_tiles_of_one_value_have_no_border():
    volume = tiled({(x, y, z): 1.0 for x in range(6) for y in range(6) for z in range(6)})
    assert len(topology_of(volume).large.corners) == 0
    one = tiled({(3, 3, 3): 0.5})
    assert len(topology_of(one).large.blocks(0.75)) == 6 * 16**2
    assert len(topology_of(one).large.blocks(0.25)) == 0


def test_root_tiles(monkeypatch):
    like = SOURCES["level set"]()
    tree = tree_of_leaves(
        LAYOUTS["float"],
        np.float32(1.0).reshape(()),
        np.empty((0, 3), np.int32),
        np.empty((0, 64), np.uint8),
        np.empty((0, 512), np.float32),
    )
    origins = np.array([[0, 0, 0], [4096, 0, 0]], np.int32)
    root = Nodes(origins, np.array([-1.0, -1.0], np.float32), np.ones(2, np.bool_))
    volume: SparseVolume = rebuilt(replace(tree, root=root), like)
    borders = topology_of(volume).large
    # All faces but the one between the two.
    assert len(borders.corners) == 2 * 5
    assert len(borders.blocks(0.0)) == 2 * 5 * 512**2
    # 10 x 4096^2 squares of two triangles: refused before one of their cells is looked at.
    monkeypatch.setattr(estimates.available_memory, "available_host", lambda: 1 << 30)
    with pytest.raises(DeviceMemoryError, match="the faces of the surface of its active tiles need about 3840 MiB"):
        from_volume(volume, device="cpu")


@pytest.mark.parametrize("lie", ["upper checkerboard", "root tiles"])
@pytest.mark.parametrize("method", [*METHODS, "openvdb"])
def test_surfaces_that_cannot_be_counted(lie, method):
    with pytest.raises(DeviceMemoryError, match=r"its surface has more than 2147483647 .* of them between tiles"):
        from_volume(lying(SOURCES["level set"](), lie), method=method, device="cpu")
