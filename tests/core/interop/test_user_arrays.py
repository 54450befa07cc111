"""Containers at geokit's door: what comes in, what goes back, and every refusal."""

from __future__ import annotations

import gc
import sys
import types

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.core import launcher
from geokit.core.interop import arrays, user_arrays
from geokit.core.interop.user_arrays import read_vectors, require_finite_scalar
from geokit.core.memory.device_arena import ScratchArray
from geokit.core.memory.host_array import HostArray
from tests.support.devices import DEVICES

ROWS = np.array([[0.0, 1, 2], [3, 4, 5], [6, 7, 8], [0.1, 0.2, 0.3]])


@pytest.fixture(scope="module")
def cpu():
    return launcher.resolve_device("cpu")


def read(values, cpu):
    return read_vectors(values, "points", cpu)


def doubled(batch, cpu):
    """A float64 vector result, a float64 scalar result and an int32 result, made from the batch."""
    table = batch.array.numpy() * 2.0
    return (
        wp.array(table, dtype=wp.vec3d, device=cpu),
        wp.array(table[:, 0] if len(table) else np.empty(0), dtype=wp.float64, device=cpu),
        wp.array(np.arange(len(table)), dtype=wp.int32, device=cpu),
    )


class Exporter:
    """The least that a DLPack exporter has."""

    def __init__(self, array):
        self.array = array

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


class Importer(Exporter):
    """An exporter whose type can take results back."""

    @classmethod
    def from_dlpack(cls, exported):
        return cls(np.from_dlpack(exported))


class WithNamespace(Exporter):
    """An exporter of the array standard: its namespace has the importer."""

    def __array_namespace__(self):
        return types.SimpleNamespace(from_dlpack=lambda exported: WithNamespace(np.from_dlpack(exported)))


@pytest.mark.parametrize(
    "values",
    [
        ROWS,
        ROWS.tolist(),
        tuple(map(tuple, ROWS.tolist())),
        [*ROWS],
        np.asfortranarray(ROWS),
        np.repeat(ROWS, 2, axis=0)[::2],
        np.concatenate([ROWS, ROWS], axis=1)[:, :3],
        ROWS[::-1][::-1],
        ROWS.astype(">f8"),
        memoryview(ROWS),
        np.ma.masked_array(ROWS),
    ],
    ids=lambda values: type(values).__name__,
)
def test_numpy_and_its_kin(values, cpu):
    batch = read(values, cpu)
    assert (len(batch), batch.is_float32, batch.array.dtype) == (4, False, wp.vec3d)
    assert batch.array.is_contiguous
    np.testing.assert_array_equal(batch.array.numpy(), ROWS)
    vectors, scalars, integers = map(batch.to_caller, doubled(batch, cpu))
    assert {type(a) for a in (vectors, scalars, integers)} == {np.ndarray}
    assert (vectors.dtype, scalars.dtype, integers.dtype) == (np.float64, np.float64, np.int32)
    assert (vectors.shape, scalars.shape) == ((4, 3), (4,))
    np.testing.assert_array_equal(vectors, ROWS * 2)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int32, np.int64, np.float16])
@pytest.mark.parametrize("kind", ["numpy", "exporter", "warp", "gaps"])
def test_other_number_types_give_float64(dtype, kind, cpu):
    given = np.arange(6).reshape(2, 3).astype(dtype)
    wrap = {
        "numpy": lambda table: table,
        "exporter": Importer,
        "warp": lambda table: wp.array(table, dtype=wp.dtype_from_numpy(table.dtype), device="cpu"),
        "gaps": lambda table: wp.array(np.repeat(table, 2, 1), dtype=wp.dtype_from_numpy(table.dtype), device="cpu")[
            :, ::2
        ],
    }[kind]
    batch = read(wrap(given), cpu)
    if kind != "numpy":
        assert (batch.is_float32, batch.array.dtype) == (False, wp.vec3d)
        assert batch.array.numpy().tolist() == given.tolist()
        return
    assert not batch.is_float32
    assert batch.to_caller(doubled(batch, cpu)[0]).dtype == np.float64
    assert batch.array.numpy().tolist() == [[0, 1, 2], [3, 4, 5]]


def test_float32_gives_float32_but_kernels_see_float64(cpu):
    given = ROWS.astype(np.float32)
    batch = read(given, cpu)
    assert batch.is_float32
    assert batch.array.dtype == wp.vec3d
    np.testing.assert_array_equal(batch.array.numpy(), given.astype(np.float64))
    vectors, scalars, integers = map(batch.to_caller, doubled(batch, cpu))
    assert (vectors.dtype, scalars.dtype, integers.dtype) == (np.float32, np.float32, np.int32)
    np.testing.assert_array_equal(vectors, given * 2)


def test_read_only_arrays_are_read_and_stay_as_they_are(cpu):
    given = ROWS.copy()
    given.flags.writeable = False
    np.testing.assert_array_equal(read(given, cpu).array.numpy(), ROWS)
    assert not given.flags.writeable


def test_float64_numpy_is_shared_not_copied(cpu):
    given = ROWS.copy()
    assert read(given, cpu).array.ptr == given.ctypes.data


def test_the_batch_keeps_a_temporary_alive(cpu):
    batch = read(np.full((1000, 3), 7.0), cpu)
    _ = [np.zeros((1000, 3)) for _ in range(50)]
    assert (batch.array.numpy() == 7.0).all()


@pytest.mark.parametrize("values", [[], [[]], np.zeros((0, 3)), np.zeros((0,)), np.zeros((0, 3), np.int32)])
def test_empty_numpy(values, cpu):
    batch = read(values, cpu)
    assert len(batch) == 0
    vectors, scalars, _ = map(batch.to_caller, doubled(batch, cpu))
    assert (vectors.shape, scalars.shape) == ((0, 3), (0,))


@pytest.mark.parametrize("dtype", [wp.vec3f, wp.vec3d])
def test_warp_vectors_come_back_as_warp_vectors(dtype, cpu):
    batch = read(wp.array(ROWS, dtype=dtype, device="cpu"), cpu)
    assert batch.is_float32 == (dtype == wp.vec3f)
    vectors, scalars, integers = map(batch.to_caller, doubled(batch, cpu))
    assert vectors.dtype == dtype
    assert scalars.dtype == (wp.float32 if batch.is_float32 else wp.float64)
    assert integers.dtype == wp.int32
    np.testing.assert_allclose(vectors.numpy(), ROWS * 2, rtol=1e-6)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_warp_tables_come_back_as_warp_tables(dtype, cpu):
    batch = read(wp.array(ROWS, dtype=dtype, device="cpu"), cpu)
    vectors, scalars, _ = map(batch.to_caller, doubled(batch, cpu))
    assert isinstance(vectors, wp.array)
    assert (vectors.dtype, vectors.shape) == (dtype, (4, 3))
    assert (scalars.dtype, scalars.shape) == (dtype, (4,))
    np.testing.assert_allclose(vectors.numpy(), ROWS * 2, rtol=1e-6)


def test_warp_arrays_are_shared_not_copied(cpu):
    given = wp.array(ROWS, dtype=wp.vec3d, device="cpu")
    assert read(given, cpu).array.ptr == given.ptr
    table = wp.array(ROWS, dtype=wp.float64, device="cpu")
    assert read(table, cpu).array.ptr == table.ptr


@pytest.mark.parametrize("dtype", [wp.vec3f, wp.vec3d])
def test_warp_vectors_with_gaps_between_the_rows(dtype, cpu):
    given = wp.array(np.repeat(ROWS, 2, axis=0), dtype=dtype, device="cpu")[::2]
    assert not given.is_contiguous
    np.testing.assert_allclose(read(given, cpu).array.numpy(), ROWS, rtol=1e-6)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_warp_tables_with_gaps_between_the_columns(dtype, cpu):
    given = wp.array(np.concatenate([ROWS, ROWS + 50], axis=1), dtype=dtype, device="cpu")[:, 3:]
    assert not given.is_contiguous
    np.testing.assert_allclose(read(given, cpu).array.numpy(), ROWS + 50, rtol=1e-6)


@pytest.mark.parametrize("dtype", [wp.vec3f, wp.vec3d])
def test_empty_warp(dtype, cpu):
    batch = read(wp.empty(0, dtype=dtype, device="cpu"), cpu)
    assert len(batch) == 0
    vectors, scalars, _ = map(batch.to_caller, doubled(batch, cpu))
    assert vectors.shape == scalars.shape == (0,)


@pytest.mark.parametrize("kind", [Importer, WithNamespace])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exporters_come_back_as_their_own_kind(kind, dtype, cpu):
    batch = read(kind(ROWS.astype(dtype)), cpu)
    assert batch.is_float32 == (dtype == np.float32)
    vectors, scalars, integers = map(batch.to_caller, doubled(batch, cpu))
    assert {type(a) for a in (vectors, scalars, integers)} == {kind}
    assert (vectors.array.dtype, vectors.array.shape, scalars.array.shape) == (dtype, (4, 3), (4,))
    np.testing.assert_allclose(vectors.array, ROWS * 2, rtol=1e-6)


def test_exporters_are_shared_not_copied(cpu):
    given = ROWS.copy()
    assert read(Importer(given), cpu).array.ptr == given.ctypes.data


def test_an_exporter_s_library_may_have_the_importer(cpu, monkeypatch):
    library = types.ModuleType("made_up_arrays")
    library.from_dlpack = lambda exported: ("from the library", np.from_dlpack(exported))
    monkeypatch.setitem(sys.modules, "made_up_arrays", library)
    kind = type("Array", (Exporter,), {"__module__": "made_up_arrays.core"})
    label, array = read(kind(ROWS), cpu).to_caller(wp.array(ROWS, dtype=wp.vec3d, device="cpu"))
    assert label == "from the library"
    np.testing.assert_array_equal(array, ROWS)


def test_an_exporter_without_an_importer_gets_warp_tables(cpu):
    batch = read(Exporter(ROWS), cpu)
    vectors = batch.to_caller(doubled(batch, cpu)[0])
    assert isinstance(vectors, wp.array)
    assert (vectors.dtype, vectors.shape) == (wp.float64, (4, 3))


def test_an_exporter_with_gaps(cpu):
    wide = np.concatenate([ROWS, ROWS + 50], axis=1)
    np.testing.assert_array_equal(read(Importer(wide[:, 3:]), cpu).array.numpy(), ROWS + 50)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_empty_exporter(dtype, cpu):
    batch = read(Importer(np.zeros((0, 3), dtype)), cpu)
    assert len(batch) == 0
    assert batch.is_float32 == (dtype == np.float32)


def test_results_outlive_the_batch(cpu):
    vectors = read(Importer(ROWS), cpu).to_caller(wp.array(ROWS * 2, dtype=wp.vec3d, device="cpu")).array
    _ = [np.zeros((4, 3)) for _ in range(200)]
    np.testing.assert_array_equal(vectors, ROWS * 2)


@pytest.mark.parametrize("name", ["float16", "bfloat16", "int64", "uint8"])
def test_other_tensors_of_torch_give_float64(name, cpu):
    torch = pytest.importorskip("torch")
    given = torch.arange(6).reshape(2, 3).to(getattr(torch, name))
    batch = read(given, cpu)
    vectors, scalars, _ = map(batch.to_caller, doubled(batch, cpu))
    assert (vectors.dtype, scalars.dtype) == (torch.float64, torch.float64)
    assert vectors.tolist() == (2 * given).tolist()


@pytest.mark.parametrize("name", ["float32", "float64"])
def test_torch(name, cpu):
    torch = pytest.importorskip("torch")
    given = torch.tensor(ROWS, dtype=getattr(torch, name))
    batch = read(given, cpu)
    vectors, scalars, integers = map(batch.to_caller, doubled(batch, cpu))
    assert all(isinstance(a, torch.Tensor) for a in (vectors, scalars, integers))
    assert (vectors.dtype, tuple(vectors.shape), scalars.dtype) == (given.dtype, (4, 3), given.dtype)
    np.testing.assert_allclose(vectors.numpy(), ROWS * 2, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 3])
@pytest.mark.parametrize(
    "wrap",
    [
        lambda table: table,
        lambda table: table.astype(np.float32),
        lambda table: table.tolist(),
        lambda table: wp.array(table, dtype=wp.vec3d, device="cpu"),
        lambda table: wp.array(table, dtype=wp.float32, device="cpu"),
        Importer,
    ],
    ids=["float64", "float32", "lists", "warp vectors", "warp table", "exporter"],
)
def test_the_first_row_that_is_not_finite_is_named(bad, row, wrap, cpu):
    table = ROWS.copy()
    table[row, 1] = bad
    table[3, 2] = bad
    with pytest.raises(gk.InputError, match=rf"points: row {row} is not finite \(\["):
        read(wrap(table), cpu)


def test_infinities_of_both_signs(cpu):
    # Their sum is not a number, which numpy would warn of.
    with pytest.raises(gk.InputError, match="points: row 1 is not finite"):
        read([[0, 0, 0], [np.inf, -np.inf, 0]], cpu)


def test_huge_values_are_finite(cpu):
    # Their sum overflows, which the quick check takes for a reason to look closer, not for an error.
    huge = np.full((3, 3), 1.7e308)
    np.testing.assert_array_equal(read(huge, cpu).array.numpy(), huge)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((4, 2)), r"shape \(4, 2\) is not \(N, 3\)"),
        (np.zeros((4, 4)), r"shape \(4, 4\)"),
        (np.zeros(3), r"shape \(3,\)"),
        (np.zeros((2, 2, 3)), r"shape \(2, 2, 3\) is not \(N, 3\); reshape it to \(-1, 3\), and the answer back"),
        (np.zeros((3, 7)), r"shape \(3, 7\) is not \(N, 3\); transpose it"),
        (5.0, r"shape \(1,\)"),
        (np.zeros((2, 3), complex), "dtype complex128 is not a real number type"),
        (np.zeros((2, 3), bool), "dtype bool"),
        (np.array([["1", "2", "3"]]), "dtype <U1"),
        ([[1, 2, 3], [4, 5]], "cannot be read|not a real number"),
        ([[1, 2, None]], "not a real number|cannot be read"),
        (None, "NoneType is no array of numbers"),
        (types.SimpleNamespace(rows=3), "SimpleNamespace is no array of numbers"),
        ("points.ply", "not a real number|cannot be read"),
    ],
)
def test_what_numpy_cannot_make_a_table_of(values, message, cpu):
    with pytest.raises(gk.InputError, match=message) as caught:
        read(values, cpu)
    assert str(caught.value).startswith("points: ")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: wp.zeros((4, 2), dtype=wp.float64, device="cpu"), r"float64 with shape \(4, 2\)"),
        (lambda: wp.zeros(4, dtype=wp.float64, device="cpu"), r"float64 with shape \(4,\)"),
        (lambda: wp.zeros((3, 4), dtype=wp.float64, device="cpu"), r"shape \(3, 4\) .*transpose it"),
        (lambda: wp.zeros((4, 3), dtype=wp.bfloat16, device="cpu"), "bfloat16"),
        (lambda: wp.zeros((4, 3), dtype=wp.bool, device="cpu"), "bool"),
        (lambda: wp.zeros(4, dtype=wp.vec2d, device="cpu"), r"shape \(4,\)"),
        (lambda: wp.zeros((2, 2), dtype=wp.vec3d, device="cpu"), r"shape \(2, 2\)"),
        (lambda: Importer(np.zeros((4, 2))), r"shape \(4, 2\)"),
        (lambda: Importer(np.zeros((4, 3), bool)), "bool|cannot be shared"),
    ],
)
def test_arrays_of_the_wrong_kind(make, message, cpu):
    with pytest.raises(gk.InputError, match=message) as caught:
        read(make(), cpu)
    assert str(caught.value).startswith("points: ")


def test_an_exporter_that_cannot_be_shared(cpu):
    class Broken:
        def __dlpack__(self, **options):
            raise BufferError("it requires gradients")

        def __dlpack_device__(self):
            return (1, 0)

    with pytest.raises(gk.InputError, match=r"points: the Broken cannot be shared .*gradients"):
        read(Broken(), cpu)


def test_require_finite_scalar():
    assert require_finite_scalar(np.float32(0.5), "radius", low=0.0) == 0.5
    assert require_finite_scalar(np.inf, "max_distance", infinite=True) == np.inf
    assert require_finite_scalar(-3, "isovalue") == -3.0
    for value, options, message in [
        ("wide", {}, "radius: 'wide' is not a number"),
        (None, {}, "radius: None is not a number"),
        ([1.0, 2.0], {}, "is not a number"),
        (np.nan, {}, "give a finite number"),
        (np.nan, {"infinite": True}, "give a number"),
        (np.inf, {}, "give a finite number"),
        (-np.inf, {"infinite": True, "low": 0.0}, "greater than 0"),
        (0.0, {"low": 0.0}, "give a finite number greater than 0"),
    ]:
        with pytest.raises(gk.InputError, match=message):
            require_finite_scalar(value, "radius", **options)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", [wp.vec3d, wp.vec3f])
def test_few_results_of_several_types_share_an_allocation(device, kind):
    """They are whole arrays for the caller: each keeps the memory that it is in."""
    rows = wp.array(np.arange(9.0).reshape(3, 3), dtype=kind, device=device)
    batch = user_arrays.read_vectors(rows, "rows", wp.get_device(device))
    points, numbers = user_arrays.empty_outputs(3, [wp.vec3d, wp.int32], batch.rows)
    assert isinstance(points, ScratchArray)
    wp.copy(points.warp, wp.array(np.arange(9.0).reshape(3, 3), dtype=wp.vec3d, device=device))
    numbers.warp.fill_(7)
    answers = batch.to_caller(points), batch.to_caller(numbers)
    del points, numbers
    gc.collect()
    taken = [wp.full(64, 5, dtype=wp.uint8, device=device) for _ in range(50)]
    assert [type(answer) for answer in answers] == [wp.array, wp.array]
    assert answers[0].dtype is kind
    np.testing.assert_array_equal(answers[0].numpy(), rows.numpy())
    np.testing.assert_array_equal(answers[1].numpy(), 7)
    assert len(taken) == 50


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, user_arrays.FEWEST_ROWS])
def test_no_results_and_many_are_arrays_of_their_own(device, count):
    rows = wp.zeros(count, dtype=wp.vec3d, device=device)
    for array, kind in zip(
        user_arrays.empty_outputs(count, [wp.vec3d, wp.int32], rows), (wp.vec3d, wp.int32), strict=True
    ):
        assert (type(array), len(array), array.dtype) == (wp.array, count, kind)
        assert array.device == rows.device


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_results_of_several_types_become_numpy_s(device, dtype):
    """Rows of NumPy's that were sent to a device, as those of a last block are."""
    batch = user_arrays.read_vectors(np.arange(6.0).reshape(2, 3).astype(dtype), "rows", wp.get_device(device))
    points, numbers = user_arrays.empty_outputs(2, [wp.vec3d, wp.int32], batch.array)
    wp.copy(points.warp, wp.array(np.arange(6.0).reshape(2, 3), dtype=wp.vec3d, device=device))
    numbers.warp.fill_(7)
    answers = batch.to_caller(points), batch.to_caller(numbers)
    assert [(type(answer), answer.dtype) for answer in answers] == [(np.ndarray, dtype), (np.ndarray, np.int32)]
    np.testing.assert_array_equal(answers[0], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(answers[1], [7, 7])


def test_results_for_rows_on_the_host_stay_there():
    batch = user_arrays.read_vectors(np.zeros((5, 3)), "rows", wp.get_device("cpu"))
    assert all(isinstance(array, HostArray) for array in user_arrays.empty_outputs(5, [wp.vec3d, wp.int32], batch.rows))


@pytest.mark.parametrize("device", DEVICES)
def test_a_row_that_is_not_finite_is_named_though_answers_are_made_first(device):
    triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    surface = gk.mesh.Surface(triangle, device=device)
    points = np.zeros((5, 3))
    points[3, 1] = np.nan
    for ask in (surface.closest_point, surface.signed_distance):
        for rows in (points, wp.array(points, dtype=wp.vec3d, device=device)):
            with pytest.raises(gk.InputError, match="points: row 3 is not finite"):
                ask(rows)


@pytest.mark.parametrize(
    ("torch_stream", "warp_stream", "is_blocking", "expected"),
    [(0, 7, True, True), (7, 7, False, True), (0, None, True, True), (0, 7, False, False), (5, 7, True, False)],
)
def test_streams_in_order_need_no_events(torch_stream, warp_stream, is_blocking, expected) -> None:
    assert isinstance(wp.Stream.is_blocking, property)
    stream = types.SimpleNamespace(cuda_stream=warp_stream, is_blocking=is_blocking)
    device = types.SimpleNamespace(is_cpu=False, ordinal=0, stream=stream)
    torch = types.SimpleNamespace(
        cuda=types.SimpleNamespace(current_stream=lambda ordinal: types.SimpleNamespace(cuda_stream=torch_stream))
    )
    assert arrays.is_in_order(torch, device) is expected


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("shape", "wide", "narrow"), [((50, 8), wp.float64, wp.float32), ((133,), wp.vec3d, wp.vec3f)])
def test_more_numbers_than_one_launch_takes_become_float32(device, shape, wide, narrow, monkeypatch):
    """8 nearest of 400 million points are more numbers than warp counts in one array of them."""
    monkeypatch.setattr(user_arrays, "NARROWED_AT_ONCE", 37)
    values = np.random.default_rng(0).normal(size=(*shape, 3) if wide is wp.vec3d else shape)
    found = user_arrays.narrowed(wp.array(values, dtype=wide, device=device), narrow)
    assert found.dtype is narrow
    assert np.array_equal(found.numpy(), values.astype(np.float32))
