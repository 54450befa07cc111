"""Adaptive distance fields: which level answers, what it says, files, and what is refused."""

from dataclasses import replace
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog import mesh_catalog
from benchmarks.catalog.float_grids import build_float_grid
from geokit.core import launcher
from geokit.errors import DeviceMemoryError, FileFormatError, InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.surface import Surface
from geokit.volume import from_dense, from_mesh, load, quantize, save
from geokit.volume.adaptive import refine
from geokit.volume.adaptive import sample_kernels as kernels
from geokit.volume.adaptive.level_sizes import common_step
from geokit.volume.adaptive.table import adaptive_table
from geokit.volume.distance_fields.adaptive import LEVEL, LEVEL_COUNT, AdaptiveSDF, adaptive_from_mesh, load_adaptive
from geokit.volume.distance_fields.plan import _adaptive
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.provenance import ORDER, with_more
from geokit.volume.sampling.leaf_table import add_pairs
from geokit.volume.sampling.leaf_table_kernels import LeafTable
from geokit.volume.sampling.space import world_to_index
from tests.support import reference
from tests.support.effort import of_all
from tests.volume.adaptive.test_adaptive_stability import ball_and_cube, levels_only, worst

CODECS = ("fp16", "fp8", "fp4")
SIZE = 0.4
TOLERANCE = 0.01


def _grid(values, start, size, translation, background=9.0):
    """A float grid whose active voxels are those of a dict from index to value; ``start`` is taken off the indices."""
    leaves = {}
    for index, value in values.items():
        place = np.array(index) - start
        leaf = leaves.setdefault(
            tuple(place & ~7), (np.full((8, 8, 8), background, np.float32), np.zeros((8, 8, 8), bool))
        )
        leaf[0][tuple(place & 7)], leaf[1][tuple(place & 7)] = value, True
    transform = np.diag([size, size, size, 1.0])
    transform[:3, 3] = np.array(translation) + size * np.array(start)
    buffer = build_float_grid(
        np.array(list(leaves), np.int32),
        np.stack([leaf[0].reshape(-1) for leaf in leaves.values()]),
        np.stack([leaf[1].reshape(-1) for leaf in leaves.values()]),
        background=background, transform=transform, name="g", grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    return SparseVolume(buffer, info_of(buffer, {}))


def _random_levels(seed=5, low=0, high=2):
    """Three levels of random voxels: level 1 has the halves of some cells, level 2 those of some of level 1.

    The halves of a cell are its voxels ``low`` to ``high`` along each axis.
    """
    rng = np.random.default_rng(seed)
    origin = np.array([0.3, -0.2, 0.1])
    values = [{index: rng.normal() for index in np.ndindex(12, 12, 12)}, {}, {}]
    cells = [(3, 3, 3), (3, 3, 4), (7, 7, 7), (5, 2, 9)]
    for level in (1, 2):
        for cell in cells:
            for offset in np.ndindex(*[high - low + 1] * 3):
                values[level].setdefault(tuple(2 * np.array(cell) + offset + low), rng.normal())
        cells = [(6, 6, 6), (7, 7, 9), (15, 14, 15)]
    # One voxel of a cell's halves is missing: the cell is answered by its own level.
    del values[1][10, 4, 18]
    starts = [np.array([0, 0, 0]), np.array([-3, 2, 1]), np.array([11, -8, 5])]
    return (
        values,
        tuple(
            _grid(v, start, SIZE / 2**level, origin)
            for level, (v, start) in enumerate(zip(values, starts, strict=True))
        ),
        origin,
    )


def _by_hand(values, origin, point):
    """The interpolant and its gradient by the rule, through dicts: level, value, gradient."""
    for level in (2, 1, 0):
        size = SIZE / 2**level
        u = (point - origin) / size
        cell = np.floor(u).astype(int)
        if level:
            parent = cell // 2
            if not all(tuple(2 * parent + o) in values[level] for o in np.ndindex(3, 3, 3)):
                continue
        corners = np.array([values[level].get(tuple(cell + o), 9.0) for o in np.ndindex(2, 2, 2)]).reshape(2, 2, 2)
        corners = corners.astype(np.float32).astype(float)
        return (
            level,
            reference.trilinear(corners, (u - cell)[None])[0],
            reference.trilinear_gradient(corners, (u - cell)[None])[0] / size,
        )
    raise AssertionError


@pytest.mark.slow
def test_the_finest_level_that_has_the_cell_answers():
    values, levels, origin = _random_levels()
    field = AdaptiveSDF(levels)
    rng = np.random.default_rng(1)
    points = origin + SIZE * rng.uniform(2.0, 10.0, (800, 3))
    # All of the few cells that are handed on have their share.
    for cell in [(3, 3, 3), (3, 3, 4), (7, 7, 7), (5, 2, 9)]:
        points = np.concatenate([points, origin + SIZE * (np.array(cell) + rng.uniform(size=(100, 3)))])
    expected = [_by_hand(values, origin, point) for point in points]
    assert [sum(e[0] == level for e in expected) > 25 for level in (0, 1, 2)] == [True] * 3
    np.testing.assert_allclose(field.sample(points, device="cpu"), [e[1] for e in expected], rtol=0, atol=1e-12)
    np.testing.assert_allclose(field.gradient(points, device="cpu"), [e[2] for e in expected], rtol=0, atol=1e-10)


def test_a_cell_that_lacks_one_voxel_of_its_halves_stays_with_its_level():
    values, levels, origin = _random_levels()
    point = origin + SIZE * np.array([[5.4, 2.3, 9.7]])
    alone = AdaptiveSDF(levels[:1]).sample(point, device="cpu")
    assert AdaptiveSDF(levels).sample(point, device="cpu") == alone
    values[1][10, 4, 18] = 1.0
    whole = (levels[0], _grid(values[1], np.array([-3, 2, 1]), SIZE / 2, origin))
    assert AdaptiveSDF(whole).sample(point, device="cpu") != alone


@pytest.mark.parametrize("pairs", [False, True])
def test_one_by_one_as_on_a_gpu_gives_the_same_bits(pairs):
    _, levels, origin = _random_levels()
    field = AdaptiveSDF(levels)
    points = origin + SIZE * np.random.default_rng(2).uniform(-2.0, 14.0, (5000, 3))
    device = launcher.resolve_device("cpu")
    table = adaptive_table(levels, 1, device)
    if pairs:
        for each in table.tables:
            places = np.flatnonzero(each.top.numpy() >= 0).astype(np.int32)
            add_pairs(each, wp.array(places, dtype=wp.int32, device=device), 1 << 30)
            assert each.pairs
        table.levels.tables = wp.array(table.tables, dtype=LeafTable, device=device)
    rows = wp.array(points, dtype=wp.vec3d, device=device)
    way = world_to_index(levels[0])
    for kernel, dtype, outside, grouped in (
        (kernels.SAMPLE_CUDA[False], wp.float64, wp.float64(9.0), field.sample(points, device="cpu")),
        (kernels.GRADIENT_CUDA[False], wp.vec3d, wp.vec3d(0.0, 0.0, 0.0), field.gradient(points, device="cpu")),
    ):
        out, bad = wp.empty(len(points), dtype=dtype, device=device), wp.zeros(1, dtype=wp.int32, device=device)
        launcher.launch(kernel, len(points), [table.levels, rows, *way, outside], [out, bad], device)
        np.testing.assert_array_equal(out.numpy(), grouped)


# Weights of voxels -1 to 2: the parabola through three of them, and the Catmull-Rom spline.
WEIGHTS = {
    2: np.array([[0.0, -0.5, 0.5, 0.0], [1.0, 0.0, -1.0, 0.0], [0.0, 0.5, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0]]),
    3: 0.5 * np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]),
}


def _smooth_by_hand(values, origin, point, order):
    """Level and interpolant of order 2 or 3 by the rule, through dicts."""
    last = order - 1
    for level in (2, 1, 0):
        u = (point - origin) / (SIZE / 2**level)
        cell = np.floor(u).astype(int)
        halves = np.ndindex(*[last + 3] * 3)
        if level and not all(tuple(2 * (cell // 2) + o - 1) in values[level] for o in halves):
            continue
        near = np.array([values[level].get(tuple(cell + o - 1), 9.0) for o in np.ndindex(4, 4, 4)])
        near = near.astype(np.float32).astype(float).reshape(4, 4, 4)
        x, y, z = (WEIGHTS[order] @ (u - cell) ** np.arange(4)[:, None]).T
        return level, np.einsum("ijk,i,j,k", near, x, y, z)
    raise AssertionError


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 3])
def test_the_finest_level_answers_at_higher_orders(order):
    values, levels, origin = _random_levels(low=-1, high=order)
    levels = (with_more(levels[0], {ORDER: order}), *levels[1:])
    field = AdaptiveSDF(levels)
    assert (field.order, field.codecs) == (order, ("float",) * 3)
    rng = np.random.default_rng(1)
    points = origin + SIZE * rng.uniform(2.0, 10.0, (400, 3))
    for cell in [(3, 3, 3), (3, 3, 4), (7, 7, 7), (5, 2, 9)]:
        points = np.concatenate([points, origin + SIZE * (np.array(cell) + rng.uniform(size=(100, 3)))])
    expected = [_smooth_by_hand(values, origin, point, order) for point in points]
    assert [sum(e[0] == level for e in expected) > 25 for level in (0, 1, 2)] == [True] * 3
    np.testing.assert_allclose(field.sample(points, device="cpu"), [e[1] for e in expected], rtol=0, atol=1e-12)
    step = 1e-6
    central = [
        (field.sample(points + step * axis, device="cpu") - field.sample(points - step * axis, device="cpu")) / step / 2
        for axis in np.eye(3)
    ]
    # Beside a border of cells a difference spans two interpolants.
    inner = (np.abs((points - origin) / (SIZE / 4) % 1.0 - 0.5) < 0.49).all(axis=1)
    found = field.gradient(points, device="cpu")
    np.testing.assert_allclose(found[inner], np.transpose(central)[inner], rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("codecs", [("fp16", "fp8", "fpn"), ("fp4", "float", "fp8"), ("fpn", "fp4", "fp16")])
def test_quantized_levels_answer_as_the_floats_that_their_codes_mean(order, codecs):
    low, high = (0, 2) if order == 1 else (-1, order)
    _, levels, origin = _random_levels(low=low, high=high)
    stored = [quantize(level, codec, tolerance=3.0) for level, codec in zip(levels, codecs, strict=True)]
    floats = [quantize(level, "float") for level in stored]
    field, plain = (AdaptiveSDF((with_more(few[0], {ORDER: order}), *few[1:])) for few in (stored, floats))
    assert field.codecs == codecs
    points = origin + SIZE * np.random.default_rng(3).uniform(-2.0, 14.0, (4000, 3))
    atol = 1e-11
    np.testing.assert_allclose(
        field.sample(points, device="cpu"), plain.sample(points, device="cpu"), rtol=0, atol=atol
    )
    np.testing.assert_allclose(
        field.gradient(points, device="cpu"), plain.gradient(points, device="cpu"), rtol=0, atol=10 * atol / SIZE
    )
    with pytest.raises(InputError, match="row 1 is not finite"):
        field.sample([[0.0, 0.0, 0.0], [0.0, np.inf, 0.0]], device="cpu")
    assert field.sample([[1e300, 0.0, 0.0]], device="cpu") == field.levels[0].info.background
    assert field.sample(points.astype(np.float32), device="cpu").dtype == np.float32


@pytest.mark.parametrize("order", [1, 2, 3])
def test_one_level_of_any_order_and_codec_is_the_volume(order):
    volume = with_more(quantize(from_mesh(mesh_catalog.torus(), 0.1, device="cpu"), "fp8"), {ORDER: order})
    points = np.random.default_rng(3).uniform(-2.5, 2.5, (5000, 3))
    field = AdaptiveSDF((volume,))
    np.testing.assert_array_equal(field.sample(points, device="cpu"), volume.sample(points, device="cpu"))
    np.testing.assert_array_equal(field.gradient(points, device="cpu"), volume.gradient(points, device="cpu"))


@pytest.mark.parametrize("ending", [".nvdb", ".vdb"])
def test_files_keep_order_and_codec(tmp_path, ending):
    _, levels, origin = _random_levels(low=-1, high=3)
    stored = [with_more(quantize(level, codec), {ORDER: 3}) for level, codec in zip(levels, CODECS, strict=True)]
    for number, level in enumerate(stored):
        with_more(level, {LEVEL: number, LEVEL_COUNT: 3})
    stored = [SparseVolume(level.nanovdb, replace(level.info, name=f"level {n}")) for n, level in enumerate(stored)]
    field = AdaptiveSDF(tuple(stored))
    field.save(tmp_path / f"field{ending}")
    back = load_adaptive(tmp_path / f"field{ending}")
    assert back.order == 3
    # OpenVDB has no quantized grids.
    assert back.codecs == (CODECS if ending == ".nvdb" else ("float",) * 3)
    points = origin + SIZE * np.random.default_rng(3).uniform(-2.0, 14.0, (2000, 3))
    np.testing.assert_allclose(
        back.sample(points, device="cpu"), field.sample(points, device="cpu"), rtol=0, atol=1e-12
    )


def test_a_field_without_a_record_of_its_order_has_order_1():
    _, levels, _ = _random_levels()
    field = AdaptiveSDF(levels)
    assert (field.order, field.codecs) == (1, ("float",) * 3)


def test_a_field_of_one_level_is_the_volume():
    volume = from_mesh(mesh_catalog.torus(), 0.08, device="cpu")
    points = np.random.default_rng(3).uniform(-2.5, 2.5, (20_000, 3))
    points = np.concatenate([points, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e9, 0.0, 0.0], [-1e300, 1e300, 0.0]]])
    field = AdaptiveSDF((volume,))
    np.testing.assert_array_equal(field.sample(points, device="cpu"), volume.sample(points, order=1, device="cpu"))
    np.testing.assert_array_equal(field.gradient(points, device="cpu"), volume.gradient(points, order=1, device="cpu"))


def profile_mesh():
    """Turned off the lattice."""
    mesh = mesh_catalog.l_profile()
    turn = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
    return TriangleMesh(mesh.vertices @ (turn * np.sign(np.linalg.det(turn))).T, mesh.faces, name="profile")


# The search takes ten seconds, and with it each test is slow.
@pytest.fixture(scope="module", params=[pytest.param("profile", marks=pytest.mark.slow)])
def profile():
    turned = profile_mesh()
    return turned, adaptive_from_mesh(turned, TOLERANCE, order=1, codec="float", device="cpu")


# Of a face.
SAMPLES = of_all(150, 400)


def test_error_against_brute_force(profile):
    mesh, field = profile
    rng = np.random.default_rng(9)
    corners = mesh.vertices[mesh.faces]
    weights = rng.dirichlet([1.0, 1.0, 1.0], (SAMPLES, len(corners)))
    points = np.einsum("nfk,fkd->nfd", weights, corners).reshape(-1, 3)
    # On the edges too, where interpolants are worst.
    t = rng.uniform(size=(SAMPLES, len(corners), 1))
    points = np.concatenate([points, (corners[:, 0] * t + corners[:, 1] * (1 - t)).reshape(-1, 3)])
    points = points + rng.normal(size=points.shape) * (0.3 * TOLERANCE)
    exact = reference.signed_distance(mesh.vertices, mesh.faces, points)
    zone = np.abs(exact) <= TOLERANCE
    assert zone.sum() > 20 * SAMPLES
    errors = np.abs(field.sample(points, device="cpu") - exact)[zone]
    assert errors.max() <= TOLERANCE
    # The promise is made use of: it could not be kept with much less.
    assert field.achieved_error > 0.7 * TOLERANCE


def test_it_has_levels_and_says_so(profile):
    _, field = profile
    assert field.level_count == len(field.levels) >= 3
    np.testing.assert_allclose(np.array(field.voxel_sizes[:-1]) / field.voxel_sizes[1:], 2.0)
    assert field.byte_count == sum(len(level.nanovdb) for level in field.levels)
    assert field.achieved_error_999 <= field.achieved_error <= field.tolerance == TOLERANCE
    for number, level in enumerate(field.levels):
        metadata = level.info.metadata
        assert (metadata[LEVEL], metadata[LEVEL_COUNT]) == (number, field.level_count)
        assert metadata["geokit:checked_within"] == TOLERANCE
        assert metadata["geokit:source"] == "profile"
        assert metadata["geokit:order"] == 1
    assert field.levels[0].info.grid_class == "level set"
    assert "profile" in repr(field)


def test_voxels_are_exact(profile):
    mesh, field = profile
    for level in field.levels[1:]:
        dense = level.to_dense(device="cpu")
        index = np.argwhere(dense.values != np.float32(level.info.background))[::7]
        points = dense.transform[:3, :3] @ (index + dense.origin).T + dense.transform[:3, 3:]
        exact = reference.signed_distance(mesh.vertices, mesh.faces, points.T)
        np.testing.assert_allclose(dense.values[tuple(index.T)], exact, rtol=1e-6, atol=1e-7)


def test_less_memory_than_one_voxel_size(profile):
    mesh, field = profile
    uniform = from_mesh(mesh, field.voxel_sizes[-1], half_width=np.sqrt(3.0) + 1.0 / 3.0, device="cpu")
    assert 2 * field.byte_count < uniform.info.byte_count


def test_far_away_it_is_the_band_s_edge(profile):
    mesh, field = profile
    background = field.levels[0].info.background
    middle = mesh.vertices[mesh.faces].reshape(-1, 3).mean(axis=0)
    assert field.sample([[1e6, 0.0, 0.0], [-30.0, 2.0, 1e5]], device="cpu").tolist() == [background] * 2
    assert field.gradient([[1e6, 0.0, 0.0]], device="cpu").tolist() == [[0.0, 0.0, 0.0]]
    solid = adaptive_from_mesh(mesh_catalog.box(), 0.05, order=1, codec="float", device="cpu")
    assert solid.sample([[0.5, 0.5, 0.5]], device="cpu")[0] == -solid.levels[0].info.background
    assert np.isfinite(field.sample(middle[None], device="cpu")).all()


def test_a_part_drawn_on_a_lattice_keeps_its_straight_edges_for_nothing(profile):
    _, turned = profile
    aligned = adaptive_from_mesh(mesh_catalog.l_profile(), TOLERANCE, order=1, codec="float", device="cpu")
    assert 2 * aligned.byte_count < turned.byte_count


def test_common_step():
    lower = (0.1, 0.2, 0.3)
    assert common_step(mesh_catalog.box(lower, (2.1, 1.2, 3.3))) == pytest.approx(1.0)
    assert common_step(mesh_catalog.box(lower, (2.1, 0.7, 1.05))) == pytest.approx(0.25)
    # An edge of pi has no step in common with one of 1.
    assert common_step(mesh_catalog.box((0, 0, 0), (1, 1, np.pi))) is None
    assert common_step(mesh_catalog.icosphere()) is None


@pytest.mark.parametrize("ending", [".nvdb", ".vdb"])
def test_files(profile, tmp_path, ending):
    _, field = profile
    path = tmp_path / f"field{ending}"
    field.save(path)
    back = load_adaptive(path)
    assert back.byte_count == field.byte_count
    assert (back.tolerance, back.achieved_error) == (field.tolerance, field.achieved_error)
    points = np.random.default_rng(4).uniform(-3.0, 3.0, (5000, 3))
    np.testing.assert_array_equal(back.sample(points, device="cpu"), field.sample(points, device="cpu"))
    # Any reader of volumes takes level 0.
    assert load(path, grid="profile").info.grid_class == "level set"


def test_files_with_other_grids_or_of_other_kinds(profile, tmp_path):
    _, field = profile
    other = from_mesh(mesh_catalog.box(), 0.2, name="other", device="cpu")
    save(tmp_path / "more.nvdb", other, *field.levels[::-1])
    assert load_adaptive(tmp_path / "more.nvdb").voxel_sizes == field.voxel_sizes
    save(tmp_path / "none.nvdb", other)
    with pytest.raises(FileFormatError, match="no grid has 'geokit:level'"):
        load_adaptive(tmp_path / "none.nvdb")
    for name, levels in {
        "gap": field.levels[::2],
        "short": field.levels[:-1],
        "twice": (*field.levels, field.levels[0]),
    }.items():
        save(tmp_path / f"{name}.nvdb", *levels)
        with pytest.raises(FileFormatError, match="not those of one adaptive field"):
            load_adaptive(tmp_path / f"{name}.nvdb")
    forged = MappingProxyType({**other.info.metadata, LEVEL: 1, LEVEL_COUNT: 2})
    first = MappingProxyType({**field.levels[0].info.metadata, LEVEL_COUNT: 2})
    save(
        tmp_path / "mixed.nvdb",
        SparseVolume(field.levels[0].nanovdb, replace(field.levels[0].info, metadata=first)),
        SparseVolume(other.nanovdb, replace(other.info, metadata=forged)),
    )
    with pytest.raises(FileFormatError, match="not halves"):
        load_adaptive(tmp_path / "mixed.nvdb")
    with pytest.raises(InputError, match="volume"):
        field.save(tmp_path / "field.obj")


def test_containers_and_precision(profile):
    _, field = profile
    points = np.random.default_rng(6).uniform(-1.0, 2.0, (500, 3))
    wide = field.sample(points, device="cpu")
    single = field.sample(points.astype(np.float32), device="cpu")
    assert (wide.dtype, single.dtype) == (np.float64, np.float32)
    np.testing.assert_array_equal(
        single, field.sample(points.astype(np.float32).astype(float), device="cpu").astype(np.float32)
    )
    assert field.gradient(points.astype(np.float32), device="cpu").dtype == np.float32
    given = field.sample(wp.array(points, dtype=wp.vec3d, device="cpu"), device="cpu")
    np.testing.assert_array_equal(given.numpy(), wide)
    assert field.sample(np.zeros((0, 3)), device="cpu").shape == (0,)
    assert field.gradient(np.zeros((0, 3)), device="cpu").shape == (0, 3)


def test_points_that_are_refused(profile):
    _, field = profile
    for answer in (field.sample, field.gradient):
        with pytest.raises(InputError, match="row 1 is not finite"):
            answer([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], device="cpu")
        with pytest.raises(InputError, match="points"):
            answer([[0.0, 0.0]], device="cpu")


def of_ball_and_cube(max_levels=12):
    """Mesh, tolerance and field."""
    mesh, tolerance = ball_and_cube(0.1)[0], 0.004
    return mesh, tolerance, levels_only(mesh, tolerance, 1, "float", max_levels)


def of_profile(max_levels=12):
    mesh = profile_mesh()
    options = {"order": 1, "codec": "float", "max_levels": max_levels, "device": "cpu"}
    return mesh, TOLERANCE, adaptive_from_mesh(mesh, TOLERANCE, **options)


# The profile's search takes ten seconds.
MAKERS = of_all([of_ball_and_cube], [of_ball_and_cube, of_profile])


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS)
def test_the_same_bytes_for_any_number_of_threads(make, monkeypatch):
    _, _, field = make()
    assert field.level_count > 1
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    _, _, again = make()
    assert [level.nanovdb.tobytes() for level in again.levels] == [level.nanovdb.tobytes() for level in field.levels]


@pytest.mark.slow
def test_an_open_mesh_keeps_it_within_a_quarter():
    shell = mesh_catalog.half_shell(mesh_catalog.icosphere(2))
    field = adaptive_from_mesh(shell, 0.05, order=1, codec="float", device="cpu")
    assert field.levels[0].info.metadata["geokit:checked_within"] == 0.0125
    assert field.achieved_error <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS)
def test_fewer_levels_take_more_memory_and_keep_the_tolerance(make):
    mesh, tolerance, field = make()
    _, _, fewer = make(field.level_count - 1)
    assert fewer.level_count < field.level_count
    assert worst(fewer, mesh, [mesh], tolerance) <= tolerance
    assert fewer.byte_count > field.byte_count


@pytest.mark.slow
def test_a_tolerance_out_of_reach_is_refused():
    # Beside the border of an open mesh the sign jumps: twice the distance is more than the tolerance there.
    with pytest.raises(InputError, match=r"tolerance: 0.05 is out of reach: .* use at least that, a smaller within"):
        adaptive_from_mesh(
            mesh_catalog.half_shell(mesh_catalog.icosphere(1)), 0.05, within=0.1, order=1, codec="float", device="cpu"
        )


def test_too_many_cells_are_refused(monkeypatch):
    monkeypatch.setattr(refine.available_memory, "available_host", lambda: 1 << 20)
    with pytest.raises(DeviceMemoryError, match="use a larger tolerance"):
        adaptive_from_mesh(mesh_catalog.torus(), 1e-4, order=1, device="cpu")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"tolerance": "much"}, "tolerance"),
        ({"within": -0.1}, "within: -0.1 is not usable; give a finite number, 0 or more"),
        ({"within": np.inf}, "within"),
        ({"max_levels": 0}, "max_levels: 0"),
        ({"max_levels": True}, "max_levels: True"),
        ({"max_levels": 2.5}, "max_levels: 2.5"),
        ({"sign": "none"}, "sign: 'none'"),
        ({"sign": "guess"}, "sign: 'guess'"),
        ({"order": 0}, "order: 0"),
        ({"codec": "fp7"}, "codec: 'fp7'"),
    ],
)
def test_arguments_that_are_refused(options, match):
    with pytest.raises(InputError, match=match):
        adaptive_from_mesh(mesh_catalog.box(), **{"tolerance": 0.1, **options}, device="cpu")


def test_arguments_are_refused_before_anything_is_built(monkeypatch):
    monkeypatch.setattr(Surface, "__init__", lambda *_, **__: pytest.fail("a surface was built"))
    for options in ({"max_levels": 0}, {"sign": "none"}, {"sign": "guess"}, {"order": 4}, {"codec": "jpeg"}):
        with pytest.raises(InputError):
            adaptive_from_mesh(mesh_catalog.icosphere(4), **{"tolerance": 0.1, **options}, device="cpu")


def test_meshes_that_are_refused():
    with pytest.raises(InputError, match="no faces"):
        adaptive_from_mesh(TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), int)), 0.1, device="cpu")


def test_levels_that_are_refused():
    _, levels, origin = _random_levels()
    values = _random_levels()[0]
    with pytest.raises(InputError, match="levels: none given"):
        AdaptiveSDF(())
    with pytest.raises(InputError, match=r"levels\[1\]: str is not a SparseVolume"):
        AdaptiveSDF((levels[0], "more"))
    with pytest.raises(InputError, match=r"levels\[0\]: a grid of type double; give float or quantized grids"):
        AdaptiveSDF((from_dense(np.zeros((4, 4, 4)), voxel_size=1.0, grid_type="double"),))
    with pytest.raises(InputError, match="level 1 are not halves of those of level 0"):
        AdaptiveSDF(levels[::2])
    with pytest.raises(InputError, match="level 1 are not halves"):
        AdaptiveSDF((levels[0], _grid(values[1], np.zeros(3, int), SIZE / 2, origin + 0.01)))
    with pytest.raises(InputError, match="too far apart"):
        AdaptiveSDF((levels[0], _grid({(0, 0, 0): 1.0}, np.zeros(3, int), SIZE / 2, origin + SIZE * 2.0**30)))


@pytest.mark.parametrize(("order", "reach"), [(1, 3.0**0.5), (2, 12.0**0.5), (3, 12.0**0.5)])
def test_the_planned_band_holds_the_stencils_of_all_points_within(order, reach):
    size, within = 0.03125, 0.1
    storage = SimpleNamespace(order=order, within=within, tolerance=0.01, codec_of=lambda size: "fp16")
    lattice = SimpleNamespace(size=size)
    tree = SimpleNamespace(storage=storage, lattice=lattice, lattice_of=lambda level: lattice, level_count=4)
    row = _adaptive(tree, 1000.4, 2.0)
    assert row.half_width * size == pytest.approx(reach * size + within)
    assert (row.order, row.codec, row.voxel_size, row.byte_count, row.level_count) == (order, "fp16", size, 1000, 4)
