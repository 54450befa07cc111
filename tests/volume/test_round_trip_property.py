"""Whatever leaves, transform, name and codec: a saved volume comes back bit for bit, and inputs are never changed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import VOXELS, lookup
from geokit import native
from geokit.volume import inspect, load, save
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import info_of

SETTINGS = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
# Few cells, so that leaves share nodes, and cells at the ends of the index space.
CELLS = st.one_of(st.integers(-3, 3), st.sampled_from([-(1 << 28), (1 << 28) - 1, -513, 512, 4095]))
# Relative to a voxel; far below what index coordinates of float64 resolve at the ends of the index space.
NOTHING = 1e-13
FILE_KINDS = [".nvdb"] + ([".vdb"] if native.available() else [])


@st.composite
def transforms(draw):
    angles = [draw(st.floats(-np.pi, np.pi)) for _ in range(3)]
    matrix = np.eye(4)
    for axis, angle in enumerate(angles):
        turn = np.eye(4)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
        matrix = matrix @ turn
    # OpenVDB takes voxels smaller than about 1e-5 for singular.
    matrix[:3, :3] *= 10.0 ** draw(st.floats(-3, 4))
    matrix[:3, 3] = [draw(st.floats(-1e9, 1e9)) for _ in range(3)]
    return matrix


@st.composite
def volumes(draw):
    cells = draw(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1, max_size=6, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    values = rng.standard_normal((len(cells), 512)).astype(np.float32)
    masks = rng.random((len(cells), 512)) < draw(st.sampled_from([0.0, 0.01, 0.5, 1.0]))
    masks[0, 0] = True
    origins = 8 * np.array(cells, np.int64).astype(np.int32)
    name = draw(st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=40))
    background = draw(st.floats(-10.0, 10.0, width=32))
    inputs = [origins.copy(), values.copy(), masks.copy()]
    buffer = build_float_grid(
        origins, values, masks,
        background=background, transform=draw(transforms()), name=name, grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    assert all(np.array_equal(a, b) for a, b in zip(inputs, (origins, values, masks), strict=True))
    return SparseVolume(buffer, info_of(buffer)), origins, values, masks, background


@pytest.mark.slow
@given(volumes())
@SETTINGS
def test_every_leaf_value_is_found(made):
    volume, origins, values, masks, background = made
    check_grid(volume.nanovdb, "made")
    voxels = (origins[:, None, :].astype(np.int64) + VOXELS).reshape(-1, 3)
    assert np.array_equal(lookup(volume.nanovdb, voxels), values.ravel())
    active = voxels[masks.ravel()]
    assert volume.info.active_voxel_count == len(active)
    assert np.array_equal(volume.info.index_bounds, [active.min(axis=0), active.max(axis=0)])
    away = np.array([[1 << 20, 3, 3], [-(1 << 20), 0, 0]])
    assert (lookup(volume.nanovdb, away) == np.float32(background)).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILE_KINDS)
@given(volumes(), st.sampled_from(["none", "zip", "blosc"]))
@SETTINGS
def test_files_keep_everything(tmp_path, kind, made, codec):
    volume, origins, values, _, background = made
    before = volume.nanovdb.copy()
    path = tmp_path / f"x{kind}"
    save(path, volume, codec=codec)
    loaded = load(path)
    assert np.array_equal(volume.nanovdb, before)
    if kind == ".nvdb":
        assert np.array_equal(loaded.nanovdb[16:], before[16:])
        assert inspect(path)[0].name == volume.info.name
    voxels = (origins[:, None, :].astype(np.int64) + VOXELS).reshape(-1, 3)
    assert np.array_equal(lookup(loaded.nanovdb, voxels), values.ravel())
    expected = volume.info.transform
    # OpenVDB drops entries that are nothing next to the voxel: the residue of a turn by 90 degrees, say.
    dropped = (kind == ".vdb") & (np.abs(expected) < NOTHING * volume.info.voxel_size.min())
    assert (np.where(dropped, 0.0, loaded.info.transform - expected) == 0.0).all()
    assert np.abs(loaded.info.transform - expected).max() <= NOTHING * volume.info.voxel_size.min()
    assert loaded.info.background == np.float32(background)
    assert (loaded.info.name, loaded.info.active_voxel_count) == (volume.info.name, volume.info.active_voxel_count)
    assert np.array_equal(loaded.info.index_bounds, volume.info.index_bounds)
