"""Grids built by kernels: the same bytes as the typed writer's, integers, signs, and every error it promises."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import ROTATED, lookup, sphere_leaves
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.device_leaves import build_leaves, leaf_keys
from geokit.volume.tree.flood_signs import with_signs
from geokit.volume.tree.grid_head import checked_head
from geokit.volume.tree.typed_tree import tree_of_leaves
from geokit.volume.tree.typed_writer import build_grid


def both(origins, values, masks, *, grid_class="level set", transform=None, background=3.0):
    """The device writer's grid, and that of the typed writer, which shares only head and signs with it."""
    transform = np.eye(4) if transform is None else transform
    signed = grid_class == "level set"
    head = checked_head("float", background, -background, transform, "g", grid_class)
    ours = build_leaves(head, origins, values, masks, signed=signed)
    packed = masks if masks.dtype == np.uint8 else np.packbits(masks, axis=1, bitorder="little")
    tree = tree_of_leaves(LAYOUTS["float"], np.float32(background), origins, packed, values)
    theirs = build_grid(with_signs(tree, head.inside) if signed else tree, head)
    return ours, theirs


@pytest.mark.slow
@pytest.mark.parametrize("center", [(0, 0, 0), (-4100, 37, 12345), (-8, 4095, -4096)])
@pytest.mark.parametrize("radius", [6.0, 40.0, 150.0])
def test_bytes_are_those_of_the_typed_writer(radius, center):
    ours, theirs = both(*sphere_leaves(radius, center))
    np.testing.assert_array_equal(ours, theirs)
    check_grid(ours, "grid")
    assert checksum_matches(ours)


def test_unsigned_rotated_and_shuffled_grids_are_the_same_too():
    origins, values, masks = sphere_leaves(30.0, (-4096, 0, 0))
    order = np.random.default_rng(61).permutation(len(origins))
    shuffled = origins[order], values[order], np.packbits(masks[order], axis=1, bitorder="little")
    for grid_class in ("level set", "unknown", "fog volume"):
        ours, theirs = both(*shuffled, grid_class=grid_class, transform=ROTATED, background=0.5)
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("start", [0, -8192, -4096])
@pytest.mark.parametrize(("below", "above"), [(-3.0, -3.0), (-3.0, 3.0), (3.0, 3.0)])
def test_gaps_between_upper_nodes_are_the_same(start, below, above):
    origins = np.array([[8, 8, start], [4000, 8, start + 8192], [8, -4096, start]], np.int32)
    values = np.repeat(np.array([below, above, 3.0], np.float32)[:, None], 512, axis=1)
    ours, theirs = both(origins, values, np.ones((3, 512), np.bool_))
    # The typed writer leaves tiles out that are background as everything else.
    if below == above == -3.0:
        np.testing.assert_array_equal(ours, theirs)
    rng = np.random.default_rng(63)
    voxels = rng.integers([-100, -5000, start - 5000], [5000, 5000, start + 13000], (4000, 3))
    np.testing.assert_array_equal(lookup(ours, voxels), lookup(theirs, voxels))
    check_grid(theirs, "grid")


def test_grids_without_leaves_and_without_active_voxels():
    empty = np.empty((0, 3), np.int32), np.empty((0, 512), np.float32), np.empty((0, 512), np.bool_)
    np.testing.assert_array_equal(*both(*empty))
    origins = np.array([[8, -16, 24], [-4096, 0, 0]], np.int32)
    masks = np.zeros((2, 512), np.bool_)
    np.testing.assert_array_equal(*both(origins, np.ones((2, 512), np.float32), masks))
    masks[1, 5] = True
    np.testing.assert_array_equal(*both(origins, np.ones((2, 512), np.float32), masks))


def test_integers_keep_every_value():
    origins, _, masks = sphere_leaves(20.0, (5, -70, 400))
    rng = np.random.default_rng(62)
    values = rng.integers(0, 1 << 30, masks.shape, dtype=np.int32)
    values[0] *= -2
    head = checked_head("int32", -1, -1, ROTATED, "ids", "unknown")
    buffer = build_leaves(head, origins, values, masks, signed=False)
    check_grid(buffer, "ids")
    assert checksum_matches(buffer)
    info = info_of(buffer)
    assert (info.grid_type, info.background, info.active_voxel_count) == ("int32", -1, int(masks.sum()))
    voxels = origins[:, None, :] + np.stack(np.meshgrid(*3 * [np.arange(8)], indexing="ij"), axis=-1).reshape(-1, 3)
    # The words are read as floats there; their bits are the integers (negative ones may be NaN, which loses bits).
    found = lookup(buffer, voxels[1:].reshape(-1, 3)).view(np.int32)
    np.testing.assert_array_equal(found, values[1:].reshape(-1))
    sampled = SparseVolume(buffer, info).sample(voxels[0] @ ROTATED[:3, :3].T + ROTATED[:3, 3], order=0, device="cpu")
    np.testing.assert_array_equal(sampled, values[0])
    limits = buffer[736 + 32 : 736 + 40].view(np.int32)
    assert limits.tolist() == [values[masks].min(), values[masks].max()]


@pytest.mark.parametrize(
    ("origins", "text"),
    [
        ([[0, 0, 0], [0, 4, 0]], "row 1"),
        ([[0, 0, 0], [8, 0, 0], [0, 0, 0]], "row 2 repeats row 0"),
        ([[0, 0, 1 << 31]], "row 0"),
        ([[0, 0]], r"\(1, 2\)"),
        ([[0.0, 0.0, 0.0]], "float64"),
        ([[0, 0, -(1 << 31)], [0, 0, (1 << 31) - 8]], "empty nodes"),
    ],
)
def test_unusable_origins_are_refused(origins, text):
    head = checked_head("float", 3.0, -3.0, np.eye(4), "g", "level set")
    count = len(origins)
    rows = np.ones((count, 512), np.float32), np.ones((count, 512), np.bool_)
    with pytest.raises(InputError, match=text):
        build_leaves(head, np.array(origins), *rows, signed=True)


def test_more_than_4096_upper_nodes_along_an_axis():
    origins = np.stack([4096 * np.arange(-40, 4960), np.zeros(5000), np.zeros(5000)], axis=1).astype(np.int32)
    origins = origins[np.random.default_rng(64).permutation(5000)]
    values = np.repeat(np.arange(1.0, 5001.0, dtype=np.float32)[:, None], 512, axis=1)
    # A grid of 5000 upper nodes is 1.3 GB.
    few = slice(0, None, 100)
    ours, theirs = both(origins[few], values[few], np.ones((50, 512), np.bool_), grid_class="unknown")
    np.testing.assert_array_equal(ours, theirs)
    keys, uppers = leaf_keys(origins)
    assert len(np.unique(keys)) == 5000
    np.testing.assert_array_equal(uppers[keys >> 27], origins >> 12)


def test_rows_must_belong_to_leaves():
    head = checked_head("float", 3.0, -3.0, np.eye(4), "g", "level set")
    origins, values, masks = np.zeros((1, 3), np.int32), np.ones((1, 512), np.float32), np.ones((1, 512), np.bool_)
    with pytest.raises(InputError, match="leaf_values"):
        build_leaves(head, origins, values[:, :100], masks, signed=False)
    with pytest.raises(InputError, match="leaf_masks"):
        build_leaves(head, origins, values, masks[:0], signed=False)


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"transform": np.zeros((4, 4))}, "transform"),
        ({"transform": np.full((4, 4), np.nan)}, "transform"),
        ({"transform": np.eye(3)}, "transform"),
        ({"transform": np.diag([1.0, 1.0, 1.0, 2.0])}, "transform"),
        ({"name": "n" * 256}, "name"),
        ({"background": np.inf}, "background"),
        ({"inside": np.nan}, "background"),
        ({"grid_class": "smoke"}, "grid_class"),
    ],
)
def test_unusable_options_are_refused(change, argument):
    options = {"background": 3.0, "inside": -3.0, "transform": np.eye(4), "name": "g", "grid_class": "unknown"}
    with pytest.raises(InputError, match=f"^{argument}"):
        checked_head("float", **{**options, **change})
