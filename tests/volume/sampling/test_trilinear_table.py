"""Many samples through the table of leaves: the same answers, to the last bit, as one by one through the tree."""

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.float_grids import build_float_grid
from geokit.core import launcher
from geokit.errors import InputError
from geokit.volume import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.sampling import leaf_table, trilinear_table

SHEAR = np.array([[0.1, 0.02, 0.0, 3.0], [0.0, -0.2, 0.01, -1.0], [0.03, 0.0, 0.15, 0.5], [0.0, 0.0, 0.0, 1.0]])
CPU = launcher.resolve_device("cpu")


def _volume(origins, rng, transform=SHEAR, background=2.5):
    origins = np.asarray(origins, np.int32)
    values = rng.normal(size=(len(origins), 512)).astype(np.float32)
    masks = np.ones((len(origins), 512), bool)
    buffer = build_float_grid(
        origins, values, masks, background=background, transform=transform, name="v", grid_class="level set",
        signed_fill=True,
    )  # fmt: skip
    return SparseVolume(buffer, info_of(buffer, {}))


def _block(low, high):
    axis = np.arange(low, high, 8)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def _world(volume, index):
    transform = volume.info.transform
    return index @ transform[:3, :3].T + transform[:3, 3]


def _through_tree(monkeypatch, function, volume, points):
    with monkeypatch.context() as patch:
        patch.setattr(trilinear_table, "leaf_table", lambda *_: None)
        return function(volume, points, device="cpu")


def _table(volume, count=10**9):
    return leaf_table.leaf_table(volume, CPU, count)


LEAVES = {
    "one": [[0, 0, 0]],
    "around the origin, whole": _block(-16, 16),
    "over a border of lower nodes": _block(112, 144),
    "over a border of upper nodes": _block(4080, 4112),
    "holes": _block(-24, 24)[::3],
    "two far apart": [[0, 0, 0], [1000, -2000, 504]],
    "far from the origin": _block(0, 16) + np.array([1 << 30, -(1 << 30), 1 << 29]),
}


@pytest.fixture(params=LEAVES)
def volume(request):
    return _volume(LEAVES[request.param], np.random.default_rng(1))


def _queries(volume, rng, count=4000):
    low, high = volume.info.index_bounds
    inside = rng.uniform(low - 12, high + 13, size=(count, 3))
    leaves = (rng.integers(low, high + 1, size=(count, 3)) >> 3 << 3) + rng.uniform(-1.5, 8.5, size=(count, 3))
    on_lattice = rng.integers(low - 2, high + 3, size=(count, 3)).astype(float)
    far = rng.uniform(-1, 1, size=(count, 3)) * 10.0 ** rng.uniform(0, 12, size=(count, 1))
    return _world(volume, np.concatenate([inside, leaves, on_lattice, far]))


@pytest.mark.slow
@pytest.mark.parametrize("function", [sample, gradient])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_equals_tree(volume, function, dtype, monkeypatch):
    points = _queries(volume, np.random.default_rng(2)).astype(dtype)
    expected = _through_tree(monkeypatch, function, volume, points)
    assert _table(volume) is not None
    found = function(volume, points, device="cpu")
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [False, True])
@pytest.mark.parametrize("kind", ["SAMPLE", "GRADIENT"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_of_gpus_equal_those_of_cpus(volume, kind, dtype, pairs, monkeypatch):
    from geokit.volume.sampling import trilinear_table_kernels as kernels

    function = sample if kind == "SAMPLE" else gradient
    points = _queries(volume, np.random.default_rng(3), 500).astype(dtype)
    expected = _through_tree(monkeypatch, function, volume, points)
    table = _table(volume)
    assert table is not None
    if pairs:
        starts = table.top.numpy()
        places = np.flatnonzero(starts >= 0).astype(np.int32)
        leaf_table.add_pairs(table, wp.array(places, dtype=wp.int32, device="cpu"), memory=1 << 30)
        assert table.pairs.shape[0] > 0
    # The constant is compiled into the kernels that are loaded after it has changed.
    launcher.load_module(kernels.interpolate_cpu_kernel.module, CPU)
    # A group of one query, answered by the kernel that takes one.
    monkeypatch.setattr(kernels, f"{kind}_CPU", getattr(kernels, f"{kind}_CUDA"))
    monkeypatch.setattr(kernels, "GROUP", 1)
    np.testing.assert_array_equal(function(volume, points, device="cpu"), expected)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1000])
def test_any_number_of_queries(count, monkeypatch):
    volume = _volume(_block(-16, 16), np.random.default_rng(4))
    points = _queries(volume, np.random.default_rng(5))[:count]
    expected = _through_tree(monkeypatch, sample, volume, points)
    assert _table(volume) is not None
    np.testing.assert_array_equal(sample(volume, points, device="cpu"), expected)


def test_values_that_are_not_numbers(monkeypatch):
    rng = np.random.default_rng(6)
    volume = _volume(_block(0, 16), rng)
    buffer = volume.nanovdb.copy()
    floats = buffer[-2144:].view(np.float32)
    floats[30], floats[200] = np.nan, np.inf
    damaged = SparseVolume(buffer, volume.info)
    points = _queries(damaged, rng)
    expected = _through_tree(monkeypatch, sample, damaged, points)
    assert np.isnan(expected).any()
    assert _table(damaged) is not None
    np.testing.assert_array_equal(sample(damaged, points, device="cpu"), expected)


@pytest.mark.parametrize("function", [sample, gradient])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_points_that_are_not_finite(function, bad, dtype):
    volume = _volume(_block(0, 16), np.random.default_rng(7))
    assert _table(volume) is not None
    points = np.zeros((500, 3), dtype)
    points[321, 1] = bad
    with pytest.raises(InputError, match="points: row 321 is not finite"):
        function(volume, points, device="cpu")


def test_shape_is_refused():
    volume = _volume(_block(0, 16), np.random.default_rng(8))
    assert _table(volume) is not None
    with pytest.raises(InputError, match=r"points: shape .* is not \(N, 3\)"):
        sample(volume, np.zeros((7, 2)), device="cpu")


def test_warp_arrays(monkeypatch):
    volume = _volume(_block(-16, 16), np.random.default_rng(9))
    points = _queries(volume, np.random.default_rng(10)).astype(np.float32)
    expected = _through_tree(monkeypatch, sample, volume, points)
    assert _table(volume) is not None
    found = sample(volume, wp.array(points, dtype=wp.vec3f, device="cpu"), device="cpu")
    assert found.dtype == wp.float32
    np.testing.assert_array_equal(found.numpy(), expected)
    strided = np.asfortranarray(points)
    np.testing.assert_array_equal(sample(volume, strided, device="cpu"), expected)


def test_answers_do_not_depend_on_order_or_threads(monkeypatch):
    volume = _volume(_block(-24, 24)[::2], np.random.default_rng(11))
    points = _queries(volume, np.random.default_rng(12))
    assert _table(volume) is not None
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    expected = sample(volume, points, device="cpu")
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    order = np.random.default_rng(13).permutation(len(points))
    np.testing.assert_array_equal(sample(volume, points[order], device="cpu"), expected[order])


class TestWhenATableIsMade:
    def test_few_queries_do_without(self):
        volume = _volume(_block(-16, 16), np.random.default_rng(14))
        assert leaf_table.leaf_table(volume, CPU, 100) is None

    def test_many_small_calls_pay_too(self):
        volume = _volume(_block(-16, 16), np.random.default_rng(15))
        made = [leaf_table.leaf_table(volume, CPU, 1000) for _ in range(40)]
        assert made[0] is None
        assert made[-1] is not None
        assert made[-2] is made[-1]

    def test_other_types_have_none(self):
        import dataclasses

        volume = _volume(_block(-16, 16), np.random.default_rng(16))
        other = SparseVolume(volume.nanovdb, dataclasses.replace(volume.info, grid_type="fp8"))
        assert _table(other) is None

    def test_a_scattered_grid_has_none(self, monkeypatch):
        far = 1 << 30
        volume = _volume([[-far, -far, -far], [far, far, far]], np.random.default_rng(17), background=0.0)
        assert _table(volume) is None
        points = _world(volume, np.array([[-far + 3.3, -far + 2.2, -far + 1.1]]))
        assert np.isfinite(sample(volume, points, device="cpu")).all()

    def test_nothing_active_has_none(self):
        volume = _volume(np.zeros((0, 3), np.int32), np.random.default_rng(18))
        assert _table(volume) is None
        assert (sample(volume, np.zeros((10, 3)), device="cpu") == 2.5).all()

    def test_at_the_end_of_index_space(self, monkeypatch):
        last = np.iinfo(np.int32).max - 7
        volume = _volume([[last, last, last]], np.random.default_rng(19), transform=np.eye(4))
        points = np.full((100, 3), float(last)) + np.random.default_rng(20).uniform(-3, 7, (100, 3))
        expected = _through_tree(monkeypatch, sample, volume, points)
        _table(volume)
        np.testing.assert_array_equal(sample(volume, points, device="cpu"), expected)
