"""Grids built by kernels: the same bytes as the NumPy builder, integers, signs, and every error it promises."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches
from geokit.volume.nanovdb.header import info_of
from geokit.volume.tree.build_float import build_float_grid
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import checked_head
from tests.support.sphere_volumes import ROTATED, lookup, sphere_leaves


def both(origins, values, masks, *, grid_class="level set", transform=None, background=3.0):
    transform = np.eye(4) if transform is None else transform
    signed = grid_class == "level set"
    head = checked_head("float", background, -background, transform, "g", grid_class)
    ours = build_leaves(head, origins, values, masks, signed=signed)
    theirs = build_float_grid(
        origins,
        values,
        masks,
        background=background,
        transform=transform,
        name="g",
        grid_class=grid_class,
        signed_fill=signed,
    )
    return ours, theirs


@pytest.mark.parametrize("center", [(0, 0, 0), (-4100, 37, 12345), (-8, 4095, -4096)])
@pytest.mark.parametrize("radius", [6.0, 40.0, 150.0])
def test_bytes_are_those_of_the_other_builder(radius, center):
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
    np.testing.assert_array_equal(ours, theirs)


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
        ([[4096 * i, 0, 0] for i in range(4097)], "more than 4096"),
    ],
)
def test_unusable_origins_are_refused(origins, text):
    head = checked_head("float", 3.0, -3.0, np.eye(4), "g", "level set")
    count = len(origins)
    rows = np.ones((count, 512), np.float32), np.ones((count, 512), np.bool_)
    with pytest.raises(InputError, match=text):
        build_leaves(head, np.array(origins), *rows, signed=True)


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
