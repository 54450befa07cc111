"""Grids that lie are refused before an operation depends on the lie; test_lying_grids_stability.py has all of them."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit import native
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.tree.estimates import counts_of, least_leaves, require_openvdb_room, require_places
from geokit.volume.tree.typed_tree import tree_of, tree_of_leaves
from geokit.volume.tree.typed_writer import rebuilt
from tests.support.lying_grids import OPERATIONS, SOURCES, lying

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")
CPU = {"device": "cpu"}


@pytest.fixture(scope="module")
def torus():
    return SOURCES["level set"]()


@pytest.mark.parametrize("source", SOURCES)
def test_counts(source):
    sound = SOURCES[source]()
    leaves, lower, upper, root, box = counts_of(sound)
    assert (leaves, lower, upper, root) == (grid_nodes(sound.nanovdb).leaf.count, 0, 0, 0)
    first, last = sound.info.index_bounds
    np.testing.assert_array_equal(box, [first // 4096 * 512, last // 4096 * 512 + 511])
    node = grid_nodes(sound.nanovdb).upper
    assert counts_of(lying(sound, "upper tiles")).upper_tiles == 32**3 - np.unpackbits(node.child_mask[0]).sum()
    assert counts_of(lying(sound, "lower tiles")).lower_tiles > 0
    assert counts_of(lying(sound, "root tiles")).root_tiles == 64


def test_counts_do_not_trust_the_header(torus):
    lied = lying(torus, "voxel count 0")
    assert counts_of(lied)[:4] == counts_of(torus)[:4]
    assert not counts_of(lied).has_tiles


def test_a_false_voxel_count_hides_no_tiles(torus):
    # 32,760 active tiles of 128^3 voxels: expanded they are 134 million leaves.
    with pytest.raises(DeviceMemoryError, match="as voxels, the active tiles of grid 'torus' need about"):
        gk.volume.gradient_field(lying(torus, "upper tiles"), **CPU)


def test_least_leaves_of_a_ball():
    # All within 40 voxels of one voxel, against a count.
    at = np.stack(np.meshgrid(*[np.arange(-48, 48)] * 3, indexing="ij"), axis=-1)
    near = (np.square(np.maximum(np.abs(at) - 0.5, 0.0)).sum(axis=-1) < 40.0**2).reshape(12, 8, 12, 8, 12, 8)
    leaves = int(near.any(axis=(1, 3, 5)).sum())
    assert 0.5 * leaves < least_leaves(1, 40.0) <= leaves
    assert least_leaves(0, 1e300) == 0.0
    assert least_leaves(512 * 1000, 0.0) == pytest.approx(1000)
    assert least_leaves(1, 1e300) == np.inf


@pytest.mark.parametrize("operation", ["renormalize", "offset", "dilate", "erode", "opening", "closing"])
@pytest.mark.parametrize("lie", ["background 3.4e38", "background 2000", "voxels 1e-300"])
def test_a_band_that_cannot_fit_is_refused_at_once(torus, operation, lie):
    lied = lying(torus, lie)
    if operation == "offset" and lie == "voxels 1e-300":
        with pytest.raises(InputError, match=r"distance: 0.1 is 1e\+299 voxels"):
            OPERATIONS[operation](lied, "")
        return
    with pytest.raises(DeviceMemoryError, match=r"volume: a band of .* leaves needs"):
        OPERATIONS[operation](lied, "")


def test_a_wide_background_leaves_the_other_widths(torus):
    band = gk.volume.renormalize(lying(torus, "background 3.4e38"), half_width=3, **CPU)
    assert gk.volume.sample(band, [[0.7, 0.0, 0.25]], **CPU) == pytest.approx(
        gk.volume.sample(torus, [[0.7, 0.0, 0.25]], **CPU), abs=0.02
    )


@pytest.mark.parametrize(
    "operation", ["renormalize", "offset", "dilate", "union", "union other", "smooth", "statistics"]
)
@pytest.mark.parametrize("lie", ["background inf", "background nan", "background 0", "background -3.4e38"])
@needs_openvdb
def test_a_background_that_is_no_width(torus, operation, lie):
    with pytest.raises(InputError, match=r"the background of grid 'torus' is .* positive finite number"):
        OPERATIONS[operation](lying(torus, lie), "")


@needs_openvdb
def test_measures_of_huge_voxels_do_not_overflow(torus):
    # The band is 1e-301 voxels wide, too narrow for an area.
    found = gk.volume.statistics(lying(torus, "voxels 1e300"))
    assert found.count == torus.info.active_voxel_count
    assert found.area >= 0.0


@pytest.mark.slow
def test_parts_of_a_grid_with_a_wide_background(torus):
    ball = gk.volume.from_function(
        lambda p: np.linalg.norm(p - [0.0, 0.0, 1.0], axis=1) - 0.2, [[-0.5, -0.5, 0.5], [0.5, 0.5, 1.5]], 0.06
    )
    both = gk.volume.union(torus, ball)
    assert len(gk.volume.segment(both, **CPU)) == 2
    assert len(gk.volume.segment(lying(both, "background 3.4e38"), **CPU)) == 2


@pytest.mark.parametrize("lie", ["at 2^31", "at -2^31", "leaf at 2^31", "leaf at -2^31"])
@needs_openvdb
def test_openvdb_stays_away_from_the_last_index(torus, lie):
    for operation in ("smooth", "statistics", "from_volume openvdb"):
        with pytest.raises(InputError, match="grid 'torus' reaches voxels next to index 2"):
            OPERATIONS[operation](lying(torus, lie), "")


def test_bands_end_at_the_last_index():
    require_places(np.array([[-(1 << 28), 0, (1 << 28) - 1]], np.int32), "a")
    for beyond in (1 << 28, -(1 << 28) - 1):
        with pytest.raises(InputError, match="grid 'a' would reach voxels beyond index"):
            require_places(np.array([[0, 0, beyond]], np.int32), "a")


def test_a_band_beyond_the_last_index(torus):
    tree = tree_of(torus)
    moved = tree.origins + (2**31 - 8 - tree.origins.max(axis=0)).astype(np.int32)
    last = rebuilt(tree_of_leaves(tree.layout, tree.background, moved, tree.masks, tree.values), torus)
    with pytest.raises(InputError, match="beyond index 2"):
        gk.volume.renormalize(last, half_width=20, **CPU)


@pytest.mark.parametrize("lie", ["translation 1e300", "translation 1.7e308", "translation 1e18"])
@needs_openvdb
def test_transforms_that_openvdb_cannot_hold(torus, lie, tmp_path):
    for operation in ("save vdb", "from_volume openvdb"):
        with pytest.raises(InputError, match=r"OpenVDB refuses the grid .* correct its transform"):
            OPERATIONS[operation](lying(torus, lie), tmp_path)


def test_memory_is_asked_before_copies_are_made(torus, monkeypatch):
    fine = gk.volume.from_mesh(gk.mesh.from_volume(torus, **CPU), voxel_size=0.01, half_width=8, **CPU)
    assert fine.info.byte_count > 1 << 24
    coded = gk.volume.quantize(fine, "fp8")
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 20)
    with pytest.raises(DeviceMemoryError, match=r"needs? about .* MiB, of 1 MiB free"):
        gk.volume.prune(fine, tolerance=10.0)
    with pytest.raises(DeviceMemoryError, match=r"(prune: needs|the float values of grid .* need) about"):
        gk.volume.prune(coded, tolerance=10.0)
    with pytest.raises(DeviceMemoryError, match=r"OpenVDB's copies of the .* leaves"):
        require_openvdb_room(fine)
