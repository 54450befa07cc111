"""Which grid types the operations take, and what becomes of them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.errors import UnsupportedGridError
from geokit.volume._components import segment
from geokit.volume._csg import union
from geokit.volume._differential import gradient_field, laplacian
from geokit.volume._filters import smooth
from geokit.volume._morphology import offset, renormalize
from geokit.volume._resample import resample
from geokit.volume._statistics import statistics
from geokit.volume._topology import clip, prune
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.retyped.quantize import quantize
from geokit.volume.tree.leaves import leaves_of
from tests.support.analytic_volumes import active_voxels, ball, field, level_set
from tests.support.effort import of_all

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

BALL = ball(8.3, (0.3, 0.2, -0.1))
BOUNDS = [[-4.2] * 3, [9.1] * 3]
REAL = {
    "union": lambda v: union(v, v),
    "offset": lambda v: offset(v, 1.0),
    "renormalize": renormalize,
    "smooth": smooth,
    "resample": lambda v: resample(v, voxel_size=0.8, device="cpu"),
    "prune": prune,
    "clip": lambda v: clip(v, BOUNDS),
    "segment": lambda v: segment(v)[0],
    "laplacian": lambda v: laplacian(v, device="cpu"),
}


@pytest.mark.slow
@pytest.mark.parametrize("codec", of_all(["fp4", "fpn"], ["fp4", "fp8", "fp16", "fpn"]))
@pytest.mark.parametrize("name", REAL)
def test_quantized_grids_become_float(name, codec):
    body = level_set(BALL, leaves=2)
    quantized = quantize(body, codec, tolerance=1e-3 if codec == "fpn" else None)
    assert quantized.info.grid_type == codec
    before = quantized.nanovdb.copy()
    result = REAL[name](quantized)
    assert (result.info.grid_type, result.info.name) == ("float", "body")
    np.testing.assert_array_equal(quantized.nanovdb, before)
    if codec == "fp16":
        # Its step is 1e-4 voxel: as good as the float grid's.
        expected = REAL[name](body)
        assert result.info.active_voxel_count == pytest.approx(expected.info.active_voxel_count, rel=0.02)


def test_statistics_and_gradient_of_quantized_values():
    body = level_set(BALL, leaves=2)
    quantized = quantize(body, "fp16")
    exact, found = statistics(body), statistics(quantized)
    assert found.count == exact.count
    assert found[1:5] == pytest.approx(exact[1:5], abs=1e-3)
    assert found.volume == pytest.approx(exact.volume, rel=1e-3)
    assert gradient_field(quantized, device="cpu").info.grid_type == "vec3f"


@pytest.mark.parametrize("grid_type", ["float", "double", "int32", "int64", "bool", "vec3f", "vec3d"])
def test_topology_of_other_types(grid_type):
    # Two full leaves that meet, and a tile of each level.
    volume = TypedGrid(grid_type).volume
    pruned = prune(volume)
    assert pruned.info.grid_type == grid_type
    assert pruned.info.active_voxel_count == volume.info.active_voxel_count
    part = clip(volume, [[-3.2] * 3, [3.2] * 3])
    assert part.info.grid_type == grid_type
    # The leaves hold x from -8 to 7, y and z from 0 to 7.
    assert part.info.active_voxel_count == 7 * 4 * 4
    points = np.stack(np.meshgrid(np.arange(-3, 4.0), *2 * [np.arange(0, 4.0)], indexing="ij"), axis=-1).reshape(-1, 3)
    kept = np.asarray(part.sample(points, order=0, device="cpu"))
    np.testing.assert_array_equal(kept, np.asarray(volume.sample(points, order=0, device="cpu")))


@pytest.mark.parametrize("grid_type", ["int32", "int64", "bool", "vec3f"])
def test_components_of_other_types(grid_type):
    # Both leaves meet at a face; without the middle they are apart.
    volume = TypedGrid(grid_type).volume
    assert [part.info.active_voxel_count for part in segment(volume)] == [1024]
    left, right = (segment(clip(volume, [[low, 0, 0], [high, 7, 7]])) for low, high in ((-8, -2), (2, 7)))
    assert [part.info.active_voxel_count for part in (*left, *right)] == [7 * 64, 6 * 64]
    assert left[0].info.grid_type == grid_type


def test_components_of_a_mask():
    volume = TypedGrid("mask").volume
    active = np.unpackbits(leaves_of(volume).masks, axis=1, bitorder="little").reshape(-1, 8, 8, 8)
    # The grid's order of leaves: by the root's keys, where -8 is behind 0.
    block = np.concatenate([active[1], active[0]])
    labels, count = scipy.ndimage.label(block)
    parts = segment(volume)
    assert all(part.info.grid_type == "mask" for part in parts)
    sizes = np.sort(np.bincount(labels.ravel())[1:])[::-1]
    assert [int(np.unpackbits(leaves_of(part).masks).sum()) for part in parts] == sizes.tolist()
    assert len(parts) == count


@pytest.mark.parametrize("grid_type", ["int16", "half", "uint8", "rgba8", "vec3u8", "vec3u16"])
@pytest.mark.parametrize("operation", [smooth, renormalize, lambda v: resample(v, voxel_size=0.8), laplacian])
def test_types_that_openvdb_lacks(operation, grid_type):
    with pytest.raises(UnsupportedGridError):
        operation(TypedGrid(grid_type).volume)


def test_level_set_of_integers_keeps_its_class():
    import dataclasses

    source = TypedGrid("int32").volume
    info = dataclasses.replace(source.info, grid_class="level set", metadata={"class": "level set"})
    result = prune(SparseVolume(source.nanovdb, info))
    assert (result.info.grid_class, result.info.metadata["class"]) == ("level set", "level set")


def test_metadata_that_marks_the_type_is_dropped():
    source = field(lambda p: p, dtype=np.float64, background=np.zeros(3))
    import dataclasses

    info = dataclasses.replace(source.info, metadata={"geokit:value_type": "vec3i", "kept": 1})
    from geokit.volume._differential import curl

    assert dict(curl(SparseVolume(source.nanovdb, info), device="cpu").info.metadata) == {"kept": 1}
    points, _ = active_voxels(source)
    assert len(points) == 32**3
