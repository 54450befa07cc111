"""The OpenVDB bridge: what goes through a .vdb file comes back bit for bit."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geokit import native
from geokit.errors import (
    FileAccessError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    UnsupportedGridError,
)
from geokit.native import RawMetadata, VdbGrid, _openvdb
from geokit.volume.nanovdb.types import TYPES

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

# --- An independent writer of NanoVDB 32.x buffers, from the published layout -----------------------------------------

# Types that OpenVDB has too.
GRID_TYPES = {
    kind.name: (kind.number, kind.value.base, kind.value.shape)
    for kind in TYPES
    if kind.openvdb and kind.family != "quantized"
}
CLASSES = {"unknown": 0, "level set": 1, "fog volume": 2, "staggered": 3, "topology": 6}
IDENTITY = np.eye(4)


def _align(offset: int, alignment: int = 32) -> int:
    return -(-offset // alignment) * alignment


class Layout:
    """Offsets of the members of each node for one value type."""

    def __init__(self, grid_type: str) -> None:
        self.code, base, shape = GRID_TYPES[grid_type]
        self.value = np.dtype((base, shape)) if shape else np.dtype(base)
        self.is_bits = grid_type in ("bool", "mask")
        self.grid_type = grid_type
        element = np.dtype(base).itemsize
        size = self.value.itemsize
        stats = 1 if self.is_bits else (8 if element == 8 else 4)
        self.background = _align(28, element)
        self.root = _align(_align(self.background + 3 * size, stats) + 2 * stats)
        self.tile_value = 20 if element <= 4 else 24
        self.tile = _align(self.tile_value + size)
        self.slot = max(8, _align(size, max(8, element)))
        self.table = {}
        self.node = {}
        for level, count in ((2, 32**3), (1, 16**3)):
            end = 32 + 2 * count // 8 + 2 * size
            self.table[level] = _align(_align(end, stats) + 2 * stats)
            self.node[level] = _align(self.table[level] + count * self.slot)
        if self.is_bits:
            self.leaf_values, self.leaf = 80, 160 if grid_type == "bool" else 96
        else:
            self.leaf_values = _align(_align(80 + 2 * size, stats) + 2 * stats)
            self.leaf = self.leaf_values + 512 * size


def put(buffer: np.ndarray, offset: int, value: object, dtype: object) -> None:
    data = np.asarray(value, dtype=dtype).tobytes()
    buffer[offset : offset + len(data)] = np.frombuffer(data, np.uint8)


def get(buffer: np.ndarray, offset: int, dtype: object, count: int = 1) -> np.ndarray:
    dtype = np.dtype(dtype)
    return np.frombuffer(buffer.tobytes(), dtype=dtype, count=count, offset=offset)


def random_values(rng: np.random.Generator, layout: Layout, count: int) -> np.ndarray:
    kind = layout.value.base.kind
    shape = (count, *layout.value.shape)
    if kind == "f":
        return rng.normal(size=shape).astype(layout.value.base)
    if kind == "b":
        return rng.random(shape) < 0.5
    info = np.iinfo(layout.value.base)
    return rng.integers(info.min, info.max, size=shape, dtype=layout.value.base)


def make_buffer(
    grid_type: str,
    *,
    name: str = "grid",
    grid_class: str = "unknown",
    transform: np.ndarray = IDENTITY,
    seed: int = 7,
) -> np.ndarray:
    """A grid with a leaf, and with tiles (active and not) at every level; all values random, the inactive ones too."""
    rng = np.random.default_rng(seed)
    layout = Layout(grid_type)
    # Root keys in the order in which OpenVDB keeps them: by x, y, z.
    root_at = 672 + 64
    upper_at = root_at + layout.root + 3 * layout.tile
    lower_at = upper_at + layout.node[2]
    leaf_at = lower_at + layout.node[1]
    size = leaf_at + layout.leaf
    room = np.zeros(size + 32, np.uint8)
    start = -room.ctypes.data % 32
    buffer = room[start : start + size]

    put(buffer, 0, [0x304244566F6E614E], "<u8")
    put(buffer, 16, [32 << 21 | 4 << 10 | 2], "<u4")
    put(buffer, 20, [1 << 5, 0, 1], "<u4")
    put(buffer, 32, [size], "<u8")
    encoded = name.encode()
    assert len(encoded) < 256
    put(buffer, 40, np.frombuffer(encoded, np.uint8), np.uint8)
    inverse = np.linalg.inv(transform)
    put(buffer, 296, transform[:3, :3], "<f4")
    put(buffer, 332, inverse[:3, :3], "<f4")
    put(buffer, 368, transform[:3, 3], "<f4")
    put(buffer, 384, transform[:3, :3], "<f8")
    put(buffer, 456, inverse[:3, :3], "<f8")
    put(buffer, 528, transform[:3, 3], "<f8")
    put(buffer, 608, np.linalg.norm(transform[:3, :3], axis=0), "<f8")
    put(buffer, 632, [CLASSES[grid_class], layout.code], "<u4")
    put(buffer, 672, [leaf_at - 672, lower_at - 672, upper_at - 672, root_at - 672], "<u8")
    put(buffer, 704, [1, 1, 1], "<u4")

    values = random_values(rng, layout, 4)
    put(buffer, root_at + 24, [3], "<u4")
    if not layout.is_bits:
        put(buffer, root_at + layout.background, values[0], layout.value.base)
    for i, (x, state, child) in enumerate(((-4096, 0, 0), (0, 0, upper_at - root_at), (4096, 1, 0))):
        tile = root_at + layout.root + i * layout.tile
        put(buffer, tile, [(x & 0xFFFFFFFF) >> 12 << 42], "<u8")
        put(buffer, tile + 8, [child], "<i8")
        put(buffer, tile + 16, [state], "<u4")
        if not child:
            value = state if grid_type == "mask" else values[1 + i]
            put(buffer, tile + layout.tile_value, value, layout.value.base)
    for at, level, child_at, child_index in ((upper_at, 2, lower_at, 5), (lower_at, 1, leaf_at, 300)):
        put_inner(buffer, layout, at, level, child_at, child_index, rng)
    put_leaf(buffer, layout, leaf_at, rng)
    return buffer


def put_inner(
    buffer: np.ndarray, layout: Layout, at: int, level: int, child_at: int, child: int, rng: np.random.Generator
) -> None:
    count = 32**3 if level == 2 else 16**3
    active = rng.random(count) < 0.01
    active[child] = False
    children = np.zeros(count, bool)
    children[child] = True
    put(buffer, at, ORIGINS[level], "<i4")
    put(buffer, at + 32, np.packbits(active, bitorder="little"), np.uint8)
    put(buffer, at + 32 + count // 8, np.packbits(children, bitorder="little"), np.uint8)
    values = active if layout.grid_type == "mask" else random_values(rng, layout, count)
    slots = np.zeros((count, layout.slot), np.uint8)
    raw = np.ascontiguousarray(values, layout.value.base).reshape(count, -1).view(np.uint8).reshape(count, -1)
    slots[:, : raw.shape[1]] = raw
    slots[child] = 0
    slots[child, :8] = np.frombuffer(np.int64(child_at - at).tobytes(), np.uint8)
    start = at + layout.table[level]
    buffer[start : start + slots.size] = slots.reshape(-1)


# Upper node at the origin, its child 5 at z = 5 * 128, and that one's child 300 = (1, 2, 12) in units of 8.
ORIGINS = {2: (0, 0, 0), 1: (0, 0, 640), 0: (8, 16, 640 + 96)}


def put_leaf(buffer: np.ndarray, layout: Layout, at: int, rng: np.random.Generator) -> None:
    active = rng.random(512) < 0.4
    put(buffer, at, ORIGINS[0], "<i4")
    put(buffer, at + 16, np.packbits(active, bitorder="little"), np.uint8)
    values = random_values(rng, layout, 512)
    if layout.grid_type == "bool":
        put(buffer, at + layout.leaf_values, np.packbits(values, bitorder="little"), np.uint8)
    elif layout.grid_type != "mask":
        put(buffer, at + layout.leaf_values, values, layout.value.base)


def tree_content(buffer: np.ndarray) -> dict[str, bytes]:
    """Everything of a grid made of one leaf that a round trip has to keep, as bytes."""
    code = int(get(buffer, 636, "<u4")[0])
    layout = Layout(next(name for name, (number, *_) in GRID_TYPES.items() if number == code))
    leaf, lower, upper, root = (672 + int(x) for x in get(buffer, 672, "<u8", 4))
    content = {
        "counts": buffer[704:716].tobytes(),
        "transform": buffer[384:456].tobytes() + buffer[528:552].tobytes(),
        "name": buffer[40:296].tobytes(),
        "class": buffer[632:640].tobytes(),
        "background": buffer[root + layout.background :][: layout.value.itemsize].tobytes(),
        "leaf origin and states": buffer[leaf : leaf + 12].tobytes() + buffer[leaf + 16 : leaf + 80].tobytes(),
    }
    if layout.grid_type != "mask":
        end = layout.leaf_values + (64 if layout.is_bits else 512 * layout.value.itemsize)
        content["leaf values"] = buffer[leaf + layout.leaf_values : leaf + end].tobytes()
    for at, level in ((upper, 2), (lower, 1)):
        count = 32**3 if level == 2 else 16**3
        masks = buffer[at + 32 : at + 32 + count // 4]
        content[f"masks {level}"] = masks.tobytes()
        child = np.unpackbits(masks[count // 8 :], bitorder="little").astype(bool)
        slots = buffer[at + layout.table[level] :][: count * layout.slot].reshape(count, layout.slot)
        content[f"tiles {level}"] = slots[~child, : layout.value.itemsize].tobytes()
    for i in range(int(get(buffer, root + 24, "<u4")[0])):
        tile = root + layout.root + i * layout.tile
        content[f"root key {i}"] = buffer[tile : tile + 8].tobytes()
        if int(get(buffer, tile + 8, "<i8")[0]) == 0:
            value = buffer[tile + layout.tile_value :][: layout.value.itemsize].tobytes()
            content[f"root tile {i}"] = buffer[tile + 16 : tile + 20].tobytes() + value
    return content


def round_trip(tmp_path: Path, *grids: VdbGrid, trusted: bool = False, **options: object) -> list[VdbGrid]:
    path = tmp_path / "grid.vdb"
    native.write_vdb(path, grids, **options)  # type: ignore[arg-type]
    return native.read_vdb(path, trusted=trusted)


def icosphere_mesh(radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed octahedron-based sphere."""
    vertices = [np.array(v, float) for v in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(3):
        middle: dict[tuple[int, int], int] = {}

        def between(a: int, b: int, middle: dict[tuple[int, int], int] = middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in middle:
                point = vertices[a] + vertices[b]
                middle[key] = len(vertices)
                vertices.append(point / np.linalg.norm(point))
            return middle[key]

        faces = [
            t
            for a, b, c in faces
            for ab, bc, ca in [(between(a, b), between(b, c), between(c, a))]
            for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
    return radius * np.array(vertices), np.array(faces, np.int32)


ROTATED = np.eye(4)
ROTATED[:3, :3] = 0.1 * np.array([[math.cos(0.3), -math.sin(0.3), 0], [math.sin(0.3), math.cos(0.3), 0], [0, 0, 1]])
ROTATED[:3, 3] = (1 / 3, -2 / 7, 1e-3)
SHEARED = np.eye(4)
SHEARED[:3] = [[0.1, 0.02, 1e-9, 5.1], [0, 0.3, 0.07, -6.2], [0.01, 0, 0.2, 7.3]]
TRANSFORMS = {
    "identity": IDENTITY,
    "uniform": np.diag([0.1, 0.1, 0.1, 1]),
    "scale": np.diag([0.1, 0.2, 1 / 3, 1]),
    "rotated": ROTATED,
    "sheared": SHEARED,
    "mirrored": np.diag([-0.1, 0.1, 0.1, 1]),
    "far": np.array([[0.1, 0, 0, 1e7 / 3], [0, 0.1, 0, -1e9 / 7], [0, 0, 0.1, 1e5], [0, 0, 0, 1]]),
    "far, not uniform": np.array([[0.1, 0, 0, 1e7 / 3], [0, 0.2, 0, -1e9 / 7], [0, 0, 0.3, 1e5], [0, 0, 0, 1]]),
    "mirrored, rotated, far": np.array([[0, -0.1, 0, 1e8 / 9], [-0.3, 0, 0, 1], [0, 0, -0.7, -2], [0, 0, 0, 1]]),
}


# --- Round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_openvdb
@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("grid_type", sorted(GRID_TYPES))
def test_every_type_keeps_values_states_and_tiles(tmp_path: Path, grid_type: str, trusted: bool) -> None:
    grid_class = "topology" if grid_type == "mask" else "fog volume"
    buffer = make_buffer(grid_type, grid_class=grid_class, transform=SHEARED)
    (result,) = round_trip(tmp_path, VdbGrid(buffer, {}), trusted=trusted)
    expected, found = tree_content(buffer), tree_content(result.nanovdb)
    assert [key for key in expected if expected[key] != found[key]] == []
    assert set(expected) == set(found)
    assert result.metadata == {}
    assert result.nanovdb.ctypes.data % 32 == 0


@needs_openvdb
@pytest.mark.parametrize("compression", ["none", "zip", "blosc"])
def test_second_round_trip_gives_the_same_bytes(tmp_path: Path, compression: str) -> None:
    first = round_trip(tmp_path, VdbGrid(make_buffer("double"), {"a": 1}), compression=compression)
    second = round_trip(tmp_path, *first, compression=compression)
    trusted = round_trip(tmp_path, *first, compression=compression, trusted=True)
    assert np.array_equal(first[0].nanovdb, second[0].nanovdb)
    assert np.array_equal(first[0].nanovdb, trusted[0].nanovdb)


@pytest.mark.slow
@needs_openvdb
@pytest.mark.parametrize("name", sorted(TRANSFORMS))
@pytest.mark.parametrize("grid_type", ["float", "vec3d"])
def test_transforms_keep_every_bit(tmp_path: Path, name: str, grid_type: str) -> None:
    transform = TRANSFORMS[name]
    (result,) = round_trip(tmp_path, VdbGrid(make_buffer(grid_type, transform=transform), {}))
    assert get(result.nanovdb, 384, "<f8", 9).tobytes() == transform[:3, :3].astype("<f8").tobytes()
    assert get(result.nanovdb, 528, "<f8", 3).tobytes() == transform[:3, 3].astype("<f8").tobytes()
    (header,) = native.inspect_vdb(tmp_path / "grid.vdb")
    assert np.array_equal(header["transform"], transform)


@needs_openvdb
def test_active_count_of_large_tiles(tmp_path: Path) -> None:
    buffer = make_buffer("float")
    (result,) = round_trip(tmp_path, VdbGrid(buffer, {}))
    upper_at, lower_at, leaf_at = (672 + int(get(buffer, 672 + 8 * i, "<u8")[0]) for i in (2, 1, 0))
    bits = [
        int(np.unpackbits(buffer[at + start : at + start + length]).sum())
        for at, start, length in ((leaf_at, 16, 64), (lower_at, 32, 512), (upper_at, 32, 4096))
    ]
    expected = bits[0] + bits[1] * 8**3 + bits[2] * 128**3 + 4096**3
    assert int(get(result.nanovdb, 728, "<u8")[0]) == expected


@needs_openvdb
def test_several_grids_keep_order_and_names(tmp_path: Path) -> None:
    grids = [
        VdbGrid(
            make_buffer("vec3f", name="velocity", grid_class="staggered"), {"vector_type": "contravariant relative"}
        ),
        VdbGrid(make_buffer("float", name="density", seed=1), {}),
        VdbGrid(make_buffer("float", name="density", seed=2), {}),
        VdbGrid(make_buffer("int32", name=""), {"name": "ids", "class": "level set"}),
    ]
    path = tmp_path / "grids.vdb"
    native.write_vdb(path, grids)
    results = native.read_vdb(path)
    names = [bytes(grid.nanovdb[40:296]).rstrip(b"\0").decode() for grid in results]
    assert names == ["velocity", "density", "density", "ids"]
    assert results[0].metadata == {"vector_type": "contravariant relative"}
    assert results[3].metadata == {"class": "level set"}
    for source, result in zip(grids[:3], results, strict=False):
        assert tree_content(source.nanovdb) == tree_content(result.nanovdb)

    both = native.read_vdb(path, grids=["density"])
    assert [tree_content(grid.nanovdb) for grid in both] == [tree_content(grid.nanovdb) for grid in grids[1:3]]
    (second,) = native.read_vdb(path, grids=["density[1]"], trusted=True)
    assert tree_content(second.nanovdb) == tree_content(grids[2].nanovdb)
    assert native.read_vdb(path, grids=[]) == []
    again = round_trip(tmp_path, *results)
    assert again[3].metadata == {"class": "level set"}


@needs_openvdb
def test_long_names(tmp_path: Path) -> None:
    name = "a" * 300 + "ü"
    (result,) = round_trip(tmp_path, VdbGrid(make_buffer("float"), {"name": name}))
    (header,) = native.inspect_vdb(tmp_path / "grid.vdb")
    assert header["name"] == name
    (again,) = round_trip(tmp_path, result)
    assert np.array_equal(result.nanovdb, again.nanovdb)


@needs_openvdb
def test_vec3i_grids_become_vec3d_and_return(tmp_path: Path) -> None:
    buffer = make_buffer("vec3d")
    for at, count in doubles_of(buffer):
        values = get(buffer, at, "<f8", count)
        put(buffer, at, np.round(values * 1e8), "<f8")
    (result,) = round_trip(tmp_path, VdbGrid(buffer, {"geokit:value_type": "vec3i", "x": 1.5}))
    (header,) = native.inspect_vdb(tmp_path / "grid.vdb")
    assert header["grid_type"] == "vec3i"
    assert result.metadata == {"x": 1.5, "geokit:value_type": "vec3i"}
    assert tree_content(result.nanovdb) == tree_content(buffer)
    (again,) = round_trip(tmp_path, result)
    assert np.array_equal(result.nanovdb, again.nanovdb)


def doubles_of(buffer: np.ndarray) -> list[tuple[int, int]]:
    """Where the values of make_buffer("vec3d") lie: offset and number of doubles, child slots left out."""
    layout = Layout("vec3d")
    leaf, lower, upper, root = (672 + int(x) for x in get(buffer, 672, "<u8", 4))
    places = [(root + layout.background, 3), (leaf + layout.leaf_values, 3 * 512)]
    places += [(root + layout.root + i * layout.tile + layout.tile_value, 3) for i in (0, 2)]
    for at, level, child in ((upper, 2, 5), (lower, 1, 300)):
        table, count = at + layout.table[level], 32**3 if level == 2 else 16**3
        places += [(table, 3 * child), (table + 24 * (child + 1), 3 * (count - child - 1))]
    return places


@needs_openvdb
def test_vec3i_mark_on_values_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no 32-bit integer"):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("vec3d"), {"geokit:value_type": "vec3i"})])
    with pytest.raises(InputError, match="vec3d"):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("vec3f"), {"geokit:value_type": "vec3i"})])
    assert list(tmp_path.iterdir()) == []


@needs_openvdb
def test_signed_zeros_and_nans_without_compression(tmp_path: Path) -> None:
    """OpenVDB's active mask compares inactive values by ==, which tells neither -0.0 from 0.0 nor a NaN from itself."""
    buffer = make_buffer("float")
    layout = Layout("float")
    leaf, root = 672 + int(get(buffer, 672, "<u8")[0]), 672 + int(get(buffer, 696, "<u8")[0])
    put(buffer, root + layout.background, [0.0], "<f4")
    put(buffer, leaf + layout.leaf_values, np.where(np.arange(512) % 3, -0.0, np.nan), "<f4")
    (result,) = round_trip(tmp_path, VdbGrid(buffer, {}), compression="none")
    assert tree_content(result.nanovdb) == tree_content(buffer)


@needs_openvdb
def test_half_stores_sixteen_bits(tmp_path: Path) -> None:
    buffer = make_buffer("float")
    (result,) = round_trip(tmp_path, VdbGrid(buffer, {}), half=True)
    layout = Layout("float")
    leaf = 672 + int(get(buffer, 672, "<u8")[0])
    exact = get(buffer, leaf + layout.leaf_values, "<f4", 512)
    leaf = 672 + int(get(result.nanovdb, 672, "<u8")[0])
    stored = get(result.nanovdb, leaf + layout.leaf_values, "<f4", 512)
    assert np.array_equal(stored, exact.astype(np.float16).astype(np.float32))
    (header,) = native.inspect_vdb(tmp_path / "grid.vdb")
    assert header["half"]
    assert result.metadata == header["metadata"] == {"is_saved_as_half_float": True}


@needs_openvdb
@pytest.mark.parametrize("grid_type", ["float", "double", "vec3f", "vec4f", "int32", "bool"])
def test_what_was_stored_with_sixteen_bits_is_so_again(tmp_path: Path, grid_type: str) -> None:
    (first,) = round_trip(tmp_path, VdbGrid(make_buffer(grid_type), {}), half=True)
    size = (tmp_path / "grid.vdb").stat().st_size
    # Beside one that was not.
    whole = VdbGrid(make_buffer(grid_type), {"name": "whole"})
    found = round_trip(tmp_path, first, whole)
    assert [header["half"] for header in native.inspect_vdb(tmp_path / "grid.vdb")] == [True, False]
    assert [grid.metadata for grid in found] == [{"is_saved_as_half_float": True}, {}]
    assert tree_content(found[0].nanovdb) == tree_content(first.nanovdb)
    assert tree_content(found[1].nanovdb).items() - tree_content(whole.nanovdb).items() == {
        ("name", b"whole".ljust(256, b"\0"))
    }
    round_trip(tmp_path, first)
    assert (tmp_path / "grid.vdb").stat().st_size == size


@needs_openvdb
@pytest.mark.parametrize("value", [0.1, 65536.0, 1e-9])
@pytest.mark.parametrize("place", ["leaf", "lower", "upper", "background"])
def test_values_that_sixteen_bits_do_not_hold_are_written_whole(tmp_path: Path, place: str, value: float) -> None:
    (read,) = round_trip(tmp_path, VdbGrid(make_buffer("float"), {}), half=True)
    buffer, layout = read.nanovdb.copy(), Layout("float")
    leaf, lower, upper, root = (672 + int(x) for x in get(buffer, 672, "<u8", 4))
    at = {
        "leaf": leaf + layout.leaf_values + 4 * 511,
        "lower": lower + layout.table[1] + 8 * 4095,
        "upper": upper + layout.table[2] + 8 * 32767,
        "background": root + layout.background,
    }
    put(buffer, at[place], [value], "<f4")
    (result,) = round_trip(tmp_path, VdbGrid(buffer, read.metadata), compression="none")
    assert tree_content(result.nanovdb) == tree_content(buffer)
    assert result.metadata == {}
    assert not native.inspect_vdb(tmp_path / "grid.vdb")[0]["half"]


@needs_openvdb
def test_quantized_sample_becomes_float(tmp_path: Path) -> None:
    buffer = make_buffer("float")
    layout = Layout("float")
    leaf = 672 + int(get(buffer, 672, "<u8")[0])
    # Fp8: 16 bytes of origin, 64 of mask, float minimum and quantum, 4 x 16 bit statistics, 512 codes.
    head, mask = buffer[:leaf], buffer[leaf : leaf + 80]
    codes = np.random.default_rng(3).integers(0, 256, 512, dtype=np.uint8)
    body = np.zeros(16, np.uint8)
    put(body, 0, [-1.5, 0.01], "<f4")
    quantized = np.concatenate([head, mask, body, codes])
    put(quantized, 32, [len(quantized)], "<u8")
    put(quantized, 636, [14], "<u4")
    (result,) = round_trip(tmp_path, VdbGrid(quantized, {}))
    leaf = 672 + int(get(result.nanovdb, 672, "<u8")[0])
    values = get(result.nanovdb, leaf + layout.leaf_values, "<f4", 512)
    # One rounding of the product, or none where the compiler fuses it with the sum.
    np.testing.assert_allclose(values, np.float32(-1.5) + np.float32(0.01) * codes.astype(np.float32), atol=3e-7)


# --- Metadata ---------------------------------------------------------------------------------------------------------

METADATA = {
    "text": 'smoke \u00e4\n"quoted"',
    "empty": "",
    "flag": True,
    "off": False,
    "int": np.int32(-7),
    "long": 2**40,
    "single": np.float32(0.1),
    "double": 0.1,
    "infinite": math.inf,
    "vec2i": (1, -2),
    "vec3i": (1, 2, 3),
    "vec4i": (1, 2, 3, 4),
    "vec3s": (np.float32(0.1), np.float32(0.2), np.float32(0.3)),
    "vec3d": (0.1, 0.2, 0.3),
    "vec4s": (np.float32(0.1),) * 4,
    "mat4d": tuple(tuple(float(4 * i + j) / 3 for j in range(4)) for i in range(4)),
    "mat4s": tuple(tuple(np.float32(4 * i + j) / np.float32(3) for j in range(4)) for i in range(4)),
    "bytes": b"\0\xff",
    "foreign": RawMetadata("my_type", b"1234"),
}


def type_tree(value: object) -> object:
    return tuple(map(type_tree, value)) if type(value) is tuple else type(value)


@needs_openvdb
@pytest.mark.parametrize("trusted", [False, True])
def test_metadata_keeps_types_and_bits(tmp_path: Path, trusted: bool) -> None:
    (result,) = round_trip(tmp_path, VdbGrid(make_buffer("float"), METADATA), trusted=trusted)
    assert result.metadata == METADATA
    assert {k: type_tree(v) for k, v in result.metadata.items()} == {k: type_tree(v) for k, v in METADATA.items()}
    (header,) = native.inspect_vdb(tmp_path / "grid.vdb")
    assert header["metadata"] == METADATA


@needs_openvdb
@pytest.mark.parametrize("trusted", [False, True])
def test_metadata_of_the_file_are_those_of_all_its_grids(tmp_path: Path, trusted: bool) -> None:
    told = {f"geokit:file:{name}": value for name, value in METADATA.items()}
    grids = [
        VdbGrid(make_buffer("float"), {"seed": 3, "text": "own"} | told),
        VdbGrid(make_buffer("bool"), {"geokit:file:text": "later", "geokit:file:more": 1}),
    ]
    first, second = round_trip(tmp_path, *grids, trusted=trusted)
    told["geokit:file:more"] = 1
    assert (first.metadata, second.metadata) == ({"seed": 3, "text": "own"} | told, told)
    assert {name: type_tree(value) for name, value in second.metadata.items()} == {
        name: type_tree(value) for name, value in told.items()
    }
    assert [header["metadata"] for header in native.inspect_vdb(tmp_path / "grid.vdb")] == [first.metadata, told]
    # Their number follows the header of the file.
    assert int.from_bytes((tmp_path / "grid.vdb").read_bytes()[57:61], "little") == len(told)


@needs_openvdb
def test_metadata_of_a_file_do_not_fill_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "many.vdb"
    native.write_vdb(path, [VdbGrid(make_buffer("float"), {"geokit:file:a": 1, "geokit:file:b": 2})])
    data = bytearray(path.read_bytes())
    at = data.index(b"\4\0\0\0grid") - 4
    assert data[at : at + 4] == b"\1\0\0\0"
    data[at : at + 4] = (500001).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="500001 grids and 2 metadata"):
        native.read_vdb(path)


@needs_openvdb
@pytest.mark.parametrize(
    "value", [None, {}, object(), 2**70, (1,), (1, 2, 3, 4, 5), ("a", "b"), (True, False), (2**40, 1), 1j]
)
def test_metadata_without_an_openvdb_type(tmp_path: Path, value: object) -> None:
    with pytest.raises(InputError, match="'bad'"):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("float"), {"bad": value})])
    assert list(tmp_path.iterdir()) == []


@needs_openvdb
def test_a_metadata_name_that_is_not_utf8(tmp_path: Path) -> None:
    # A damaged file can hold one.
    with pytest.raises(InputError, match=r"metadata 'a\\udcff': the name holds bytes that are not UTF-8"):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("float"), {"a\udcff": 1})])


@needs_openvdb
def test_metadata_bytes_of_the_wrong_length(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs 4 bytes"):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("float"), {"bad": RawMetadata("float", b"1")})])
    assert list(tmp_path.iterdir()) == []


# --- Headers ----------------------------------------------------------------------------------------------------------


@needs_openvdb
def test_inspect_tells_what_the_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "grids.vdb"
    grids = [VdbGrid(make_buffer(t, name=t, grid_class="fog volume"), {}) for t in sorted(GRID_TYPES) if t != "mask"]
    native.write_vdb(path, grids, compression="zip")
    headers = native.inspect_vdb(path)
    assert [header["grid_type"] for header in headers] == [t for t in sorted(GRID_TYPES) if t != "mask"]
    for header, grid in zip(headers, grids, strict=True):
        layout = Layout(header["grid_type"])
        root = 672 + int(get(grid.nanovdb, 696, "<u8")[0])
        background = get(grid.nanovdb, root + layout.background, layout.value)[0]
        assert header["grid_class"] == "fog volume"
        assert np.array_equal(header["background"], background)
        assert header["active_voxel_count"] > 4096**3
        assert header["index_bounds"].shape == (2, 3)
        assert header["index_bounds"][1].tolist() == [8191, 4095, 4095]
        assert header["convertible"]
        assert not header["half"]
        assert "active values" in header["compression"]
        assert 0 < header["byte_count"] < path.stat().st_size


# --- Meshes -----------------------------------------------------------------------------------------------------------


def signed_volume(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def split(mesh: native.PolygonMesh) -> np.ndarray:
    return np.concatenate([mesh.triangles, mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]]])


@needs_openvdb
@pytest.mark.parametrize("adaptivity", [0.0, 0.5])
def test_level_set_and_back(adaptivity: float) -> None:
    vertices, faces = icosphere_mesh()
    field = native.mesh_to_level_set(vertices, faces, voxel_size=0.05)
    mesh = native.volume_to_mesh(field, adaptivity=adaptivity)
    assert mesh.points.dtype == np.float64
    plain = native.volume_to_mesh(field)
    assert len(plain.quads) > 1000
    assert (len(mesh.points) < len(plain.points) / 2) == (adaptivity > 0)
    volume = signed_volume(mesh.points, split(mesh))
    # Outward: positive. Chords of a sphere lie inside it; merged polygons have long ones.
    assert volume == pytest.approx(signed_volume(vertices, faces), rel=0.1 if adaptivity else 0.03)
    radii = np.linalg.norm(mesh.points, axis=1)
    assert abs(radii - 1).max() < 0.05


@needs_openvdb
@pytest.mark.parametrize("name", sorted(TRANSFORMS))
def test_surface_follows_the_transform_in_double(tmp_path: Path, name: str) -> None:
    vertices, faces = icosphere_mesh(10.0)
    field = native.mesh_to_level_set(vertices, faces, voxel_size=1.0)
    plain = native.volume_to_mesh(field)
    transform = TRANSFORMS[name]
    moved_field = field.copy()
    put(moved_field, 384, transform[:3, :3], "<f8")
    put(moved_field, 528, transform[:3, 3], "<f8")
    moved = native.volume_to_mesh(moved_field)
    expected = plain.points @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(moved.points, expected, rtol=1e-15, atol=1e-13)
    centered = moved.points - transform[:3, 3]
    assert signed_volume(centered, split(moved)) > 0


@pytest.mark.slow
@needs_openvdb
def test_surface_of_a_double_grid_and_of_others(tmp_path: Path) -> None:
    # Of random tiles most of a hundred million faces are near 0.
    assert native.volume_to_mesh(make_buffer("double"), isovalue=2.0).points.shape[1] == 3
    with pytest.raises(UnsupportedGridError, match="vec3s"):
        native.volume_to_mesh(make_buffer("vec3f"))
    with pytest.raises(InputError, match="isovalue"):
        native.volume_to_mesh(make_buffer("float"), isovalue=math.nan)
    with pytest.raises(InputError, match="adaptivity"):
        native.volume_to_mesh(make_buffer("float"), adaptivity=1.5)
    with pytest.raises(InputError, match="magic"):
        native.volume_to_mesh(np.zeros(4096, np.uint8))


@needs_openvdb
@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"vertices": [[0, 0, 0], [1, 0, 0], [0, math.nan, 0]]}, "row 2"),
        ({"vertices": [[0, 0], [1, 0]]}, "shapes"),
        ({"faces": [[0, 1, 3]]}, "row 0"),
        ({"faces": [[0, 1, 2], [0, -1, 2]]}, "row 1"),
        ({"faces": np.zeros((0, 3), int)}, "no faces"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "integers"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": 1e-12}, "voxel_size|singular"),
        ({"half_width": 0.5}, "half_width"),
    ],
)
def test_level_set_of_a_bad_mesh(change: dict[str, object], match: str) -> None:
    arguments = {"vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]], "voxel_size": 0.1} | change
    with pytest.raises(InputError, match=match):
        native.mesh_to_level_set(arguments.pop("vertices"), arguments.pop("faces"), **arguments)  # type: ignore[arg-type]


# --- Refusals ---------------------------------------------------------------------------------------------------------


@needs_openvdb
def test_bad_arguments(tmp_path: Path) -> None:
    path = tmp_path / "a.vdb"
    good = VdbGrid(make_buffer("float", name="there"), {})
    with pytest.raises(FileAccessError, match="no such file"):
        native.read_vdb(path)
    with pytest.raises(InputError, match="no grids"):
        native.write_vdb(path, [])
    with pytest.raises(InputError, match="compression"):
        native.write_vdb(path, [good], compression="rar")
    with pytest.raises(InputError, match="uint8"):
        native.write_vdb(path, [VdbGrid(np.zeros(10), {})])  # type: ignore[arg-type]
    with pytest.raises(FileAccessError, match="does not exist"):
        native.write_vdb(tmp_path / "nowhere" / "a.vdb", [good])
    tiny = make_buffer("float", transform=np.diag([1e-6, 1e-6, 1e-6, 1]))
    with pytest.raises(InputError, match="singular"):
        native.write_vdb(path, [VdbGrid(tiny, {})])
    assert list(tmp_path.iterdir()) == []
    native.write_vdb(path, [good])
    with pytest.raises(InputError, match="'absent'; the file holds 'there'"):
        native.read_vdb(path, grids=["absent"])
    with pytest.raises(InputError, match="list of names"):
        native.read_vdb(path, grids="there")
    with pytest.raises(InputError, match="not a grid name"):
        native.read_vdb(path, grids=["a\0b"])
    with pytest.raises(InputError, match="time_limit"):
        native.read_vdb(path, time_limit=0)
    with pytest.raises(InputError, match="memory_limit"):
        native.inspect_vdb(path, memory_limit=-1)


@needs_openvdb
@pytest.mark.parametrize(("code", "name"), [(9, "Half"), (12, "RGBA8"), (3, "int16"), (19, "Index")])
def test_types_that_openvdb_has_not(tmp_path: Path, code: int, name: str) -> None:
    buffer = make_buffer("float")
    put(buffer, 636, [code], "<u4")
    with pytest.raises(UnsupportedGridError, match=name):
        native.write_vdb(tmp_path / "a.vdb", [VdbGrid(buffer, {})])
    assert list(tmp_path.iterdir()) == []


@needs_openvdb
def test_buffers_whose_offsets_lead_astray_are_refused(tmp_path: Path) -> None:
    """Every offset, count and size of a buffer, changed: refused, or of no consequence, never followed."""
    good = make_buffer("float")
    layout = Layout("float")
    lower, upper, root = (672 + int(x) for x in get(good, 680, "<u8", 3))
    places = {
        0: "<u8", 28: "<u4", 32: "<u8", 672: "<u8", 680: "<u8", 688: "<u8", 696: "<u8", 704: "<u4", 708: "<u4",
        712: "<u4", root + 24: "<u4", root + layout.root + layout.tile + 8: "<i8",
        upper + layout.table[2] + 5 * 8: "<i8", lower + layout.table[1] + 300 * 8: "<i8",
    }  # fmt: skip
    for at, dtype in places.items():
        for value in (1, 0x7FFFFFF0, -64):
            bad = make_buffer("float")
            put(bad, at, [value & (2**32 - 1 if dtype == "<u4" else 2**63 - 1)], dtype)
            # The value that was there already, and a root table cut short, which is a sound one.
            if np.array_equal(bad, good) or (at, value) == (root + 24, 1):
                continue
            with pytest.raises(InputError, match=r"NanoVDB buffer|nanovdb"):
                native.volume_to_mesh(bad)
    # A child mask that names children that are not there.
    bad = make_buffer("float")
    bad[upper + 32 + 4096 :][:4096] = 255
    with pytest.raises(InputError, match=r"more nodes|outside the grid"):
        native.volume_to_mesh(bad)
    for size in (0, 100, 672, 735, 736, len(good) - 1):
        with pytest.raises(InputError):
            native.volume_to_mesh(good[:size])


@needs_openvdb
def test_unaligned_and_read_only_buffers_are_taken(tmp_path: Path) -> None:
    good = make_buffer("float")
    room = np.empty(len(good) + 33, np.uint8)
    start = -room.ctypes.data % 32 + 1
    room[start : start + len(good)] = good
    room.flags.writeable = False
    (result,) = round_trip(tmp_path, VdbGrid(room[start : start + len(good)], {}))
    assert tree_content(result.nanovdb) == tree_content(good)


@needs_openvdb
def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.vdb"
    native.write_vdb(path, [VdbGrid(make_buffer("float"), {})])
    before = path.read_bytes()
    with pytest.raises(InputError):
        native.write_vdb(path, [VdbGrid(np.zeros(4096, np.uint8), {})])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_missing_extension_is_named() -> None:
    code = (
        "import sys; sys.modules['geokit.native._bridge'] = None\n"
        "from geokit import MissingDependencyError, native\n"
        "assert not native.available()\n"
        "calls = [native.require, native.versions, lambda: native.read_vdb(sys.executable),\n"
        "         lambda: native.inspect_vdb(sys.executable), lambda: native.write_vdb('a.vdb', []),\n"
        "         lambda: native.volume_to_mesh(None), lambda: native.mesh_to_level_set([], [], voxel_size=1)]\n"
        "for call in calls:\n"
        "    try:\n"
        "        call()\n"
        "    except MissingDependencyError as error:\n"
        "        assert 'libopenvdb-dev' in str(error)\n"
        "    else:\n"
        "        raise SystemExit('no error')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert issubclass(MissingDependencyError, ImportError)


@needs_openvdb
def test_versions_are_those_of_the_headers() -> None:
    versions = native.versions()
    assert versions["openvdb"].startswith("10.") or int(versions["openvdb"].split(".")[0]) > 10
    assert versions["nanovdb"].split(".")[0] == "32"


# --- Peers ------------------------------------------------------------------------------------------------------------

SYSTEM_PYTHON = "/usr/bin/python3"


def pyopenvdb(script: str, *arguments: str) -> str:
    done = subprocess.run([SYSTEM_PYTHON, "-c", script, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def has_pyopenvdb() -> bool:
    if not os.path.exists(SYSTEM_PYTHON):
        return False
    return subprocess.run([SYSTEM_PYTHON, "-c", "import numpy, pyopenvdb"], capture_output=True).returncode == 0


needs_peer = pytest.mark.skipif(not has_pyopenvdb(), reason="the system's python3 has no pyopenvdb")

WRITE_WITH_PEER = """
import sys, numpy as np, pyopenvdb as vdb
values = np.random.default_rng(5).normal(size=(20, 21, 22)).astype(np.float32)
density = vdb.FloatGrid(1.5)
density.copyFromArray(values, ijk=(-3, -100, 4090))
density.fill((0, 0, 0), (300, 7, 7), -2.5, active=True)
density.name, density.gridClass = "density", vdb.GridClass.FOG_VOLUME
density.transform = vdb.createLinearTransform(voxelSize=0.3)
density.transform.rotate(0.4, vdb.Axis.Y) if hasattr(vdb, "Axis") else None
density.transform.translate((1/3, 2e5, -7))
density["author"], density["frame"], density["dt"], density["wind"] = "peer", 12, 0.1, (0.1, 0.2, 0.3)
inside = vdb.BoolGrid(False)
inside.fill((-4, 0, 0), (60, 5, 5), True)
inside.name = "inside"
velocity = vdb.Vec3SGrid((0, 0, 1))
velocity.copyFromArray(np.random.default_rng(6).normal(size=(9, 9, 9, 3)).astype(np.float32))
velocity.name, velocity.gridClass, velocity.saveFloatAsHalf = "v", vdb.GridClass.STAGGERED, True
vdb.write(sys.argv[1], grids=[density, inside, velocity], metadata={"creator": "peer"})
"""

COMPARE_WITH_PEER = """
import sys, pyopenvdb as vdb
assert vdb.readMetadata(sys.argv[1]) == vdb.readMetadata(sys.argv[2]) == {"creator": "peer"}
for name in ("density", "inside", "v"):
    a, b = vdb.read(sys.argv[1], name), vdb.read(sys.argv[2], name)
    assert a.background == b.background and a.gridClass == b.gridClass and type(a) is type(b)
    assert a.leafCount() == b.leafCount() and a.nonLeafCount() == b.nonLeafCount(), "topology"
    assert a.activeVoxelCount() == b.activeVoxelCount()
    assert a.transform == b.transform
    for p in ((0, 0, 0), (1, 2, 3), (-50, 1000, 7)):
        assert a.transform.indexToWorld(p) == b.transform.indexToWorld(p)
    assert a.saveFloatAsHalf == b.saveFloatAsHalf == (name == "v")
    # Where it is false, one of them may say so and the other say nothing.
    clean = lambda grid: {k: v for k, v in grid.metadata.items() if not k.startswith(("file_", "is_saved_as_half"))}
    assert clean(a) == clean(b), (clean(a), clean(b))
    for values in ("iterOnValues", "iterOffValues"):
        for x, y in zip(getattr(a, values)(), getattr(b, values)(), strict=True):
            assert (x.min, x.max, x.depth, x.active, x.value) == (y.min, y.max, y.depth, y.active, y.value)
print("same")
"""


@pytest.mark.slow
@needs_openvdb
@needs_peer
@pytest.mark.parametrize("trusted", [False, True])
def test_pyopenvdb_finds_nothing_changed(tmp_path: Path, trusted: bool) -> None:
    theirs, ours = str(tmp_path / "theirs.vdb"), str(tmp_path / "ours.vdb")
    pyopenvdb(WRITE_WITH_PEER, theirs)
    grids = native.read_vdb(theirs, trusted=trusted)
    assert grids[0].metadata["author"] == "peer"
    native.write_vdb(ours, grids)
    assert pyopenvdb(COMPARE_WITH_PEER, theirs, ours) == "same\n"


@pytest.mark.slow
@needs_openvdb
@needs_peer
def test_frustums_are_refused_and_the_other_grids_read(tmp_path: Path) -> None:
    path = str(tmp_path / "frustum.vdb")
    pyopenvdb(
        "import sys, pyopenvdb as vdb\n"
        "a, b = vdb.FloatGrid(), vdb.FloatGrid()\n"
        "a.name, b.name = 'camera', 'plain'\n"
        "a.transform = vdb.createFrustumTransform((0, 0, 0), (10, 10, 10), 0.5, 10.0, 1.0)\n"
        "vdb.write(sys.argv[1], grids=[a, b])\n",
        path,
    )
    with pytest.raises(UnsupportedGridError, match=r"'camera'.*frustum"):
        native.read_vdb(path)
    assert len(native.read_vdb(path, grids=["plain"])) == 1
    headers = native.inspect_vdb(path)
    assert headers[0]["transform"] is None
    assert np.array_equal(headers[1]["transform"], IDENTITY)


@needs_openvdb
def test_grid_types_that_nanovdb_has_not_are_named(tmp_path: Path) -> None:
    path = tmp_path / "points.vdb"
    native.write_vdb(path, [VdbGrid(make_buffer("float", name="soon points"), {}), VdbGrid(make_buffer("bool"), {})])
    # The same length, so that every offset of the file stays right.
    path.write_bytes(path.read_bytes().replace(b"Tree_float_5_4_3", b"Tree_quats_5_4_3"))
    with pytest.raises(UnsupportedGridError, match=r"'soon points' of type Tree_quats_5_4_3"):
        native.read_vdb(path)
    with pytest.raises(UnsupportedGridError, match="Tree_quats_5_4_3"):
        native.read_vdb(path, grids=["soon points"], trusted=True)
    assert len(native.read_vdb(path, grids=["grid"])) == 1
    headers = native.inspect_vdb(path)
    assert [header["grid_type"] for header in headers] == ["Tree_quats_5_4_3", "bool"]
    assert [header["convertible"] for header in headers] == [False, True]


@pytest.mark.slow
@needs_openvdb
def test_rocks_from_warp(tmp_path: Path) -> None:
    """A real fog volume that another program wrote."""
    warp = pytest.importorskip("warp")
    path = Path(warp.__file__).parent / "examples" / "assets" / "rocks.nvdb"
    if not path.exists():
        pytest.skip("warp's rocks.nvdb is not installed")
    with open(path, "rb") as file:
        volume = warp.Volume.load_from_nvdb(file, device="cpu")
    buffer = volume.array().numpy().copy()  # the array is the volume's own memory
    (first,) = round_trip(tmp_path, VdbGrid(buffer, {}))
    (second,) = round_trip(tmp_path, first, compression="zip")
    assert np.array_equal(first.nanovdb, second.nanovdb)
    assert get(first.nanovdb, 384, "<f8", 9).tobytes() == get(buffer, 384, "<f8", 9).tobytes()
    assert first.nanovdb[40:296].tobytes() == buffer[40:296].tobytes()
    assert first.nanovdb[632:640].tobytes() == buffer[632:640].tobytes()
    assert int(get(first.nanovdb, 728, "<u8")[0]) == int(get(buffer, 728, "<u8")[0])


@needs_openvdb
def test_errors_of_a_file_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "text.vdb"
    path.write_text(json.dumps({"not": "a grid"}))
    for trusted in (False, True):
        with pytest.raises(FileFormatError, match=r"text\.vdb"):
            native.read_vdb(path, trusted=trusted)


@pytest.mark.skipif(not os.environ.get("CI"), reason="only a CI run promises that everything is there")
def test_ci_runs_with_the_extension() -> None:
    # Without it, every test that needs OpenVDB would be skipped and the run still be green.
    assert native.available()


def test_small_files_of_a_batch_are_read_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the worker program, and by a fork of the process that is kept for them."""
    path = tmp_path / "a.vdb"
    native.write_vdb(path, [VdbGrid(make_buffer("float"), METADATA), VdbGrid(make_buffer("vec3f"), {"name": "b"})])
    found = []
    for first in (sys.maxsize, 0):
        monkeypatch.setattr(_openvdb, "FIRST_FILES", first)
        found.append([native.read_vdb(path), native.read_vdb(path, grids=["b"])])
        with pytest.raises(InputError, match=r"the file holds .*'b'"):
            native.read_vdb(path, grids=["c"])
    for ours, theirs in zip(*found, strict=True):
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one.nanovdb, other.nanovdb)
            assert one.nanovdb.ctypes.data % 32 == 0
            assert repr(one.metadata) == repr(other.metadata)


@pytest.mark.process
def test_a_limit_on_file_sizes_is_no_damage(tmp_path: Path) -> None:
    native.write_vdb(tmp_path / "a.vdb", [VdbGrid(make_buffer("float"), {})])
    code = (
        "import resource, sys; from geokit import native; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: native.read_vdb(sys.argv[1])\n"
        "except Exception as error: print(type(error).__name__, error)\n"
        "print(len(native.read_vdb(sys.argv[1], trusted=True)))"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.vdb"], capture_output=True, text=True, timeout=600)
    told, count = done.stdout.splitlines()
    assert told.startswith(
        f"FileAccessError {tmp_path / 'a.vdb'}: its voxels go through a file, which may have no more"
    )
    assert "than 1000 bytes here (ulimit -f)" in told
    assert count == "1"
