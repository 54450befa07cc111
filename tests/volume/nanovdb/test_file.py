"""Reading and writing .nvdb files: layouts, segments, codecs, checksums, and every error that the docs promise."""

from __future__ import annotations

import dataclasses
import re
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import ROTATED, sphere
from geokit.errors import (
    DeviceMemoryError,
    FileAccessError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    UnsupportedGridError,
)
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb import file as nvdb_file
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches, checksum_mode, full_checksum, partial_checksum
from geokit.volume.nanovdb.file import FILE_HEADER, FILE_METADATA, inspect, names, read
from geokit.volume.nanovdb.header import (
    GRID_DATA,
    MAGIC_FILE,
    MAGIC_GRID,
    TREE_DATA,
    aligned_buffer,
    grid_header,
    info_of,
    require_supported,
    voxel_size_of,
)
from geokit.volume.nanovdb.layout import GRID_TYPES, LAYOUTS
from geokit.volume.nanovdb.write import write

WARP = Path(wp.__file__).parent
ROCKS = WARP / "examples" / "assets" / "rocks.nvdb"
CODECS = ("none", "zip", "blosc")


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def test_layouts_are_those_of_the_header_that_warp_brings():
    text = (WARP / "native" / "nanovdb" / "PNanoVDB.h").read_text()
    table = text[text.index("pnanovdb_grid_type_constants[PNANOVDB_GRID_TYPE_END] =") :]
    rows = [[int(n) for n in row.split(",")] for row in re.findall(r"\{([\d, ]+)\}", table)[: len(GRID_TYPES)]]
    columns = (0, 5, 7, 9, 14, 15, 20, 21, 27)
    for name, row in zip(GRID_TYPES, rows, strict=True):
        if name not in LAYOUTS:
            continue
        layout = LAYOUTS[name]
        # The table gives the header of an FpN leaf, the layout its smallest size.
        leaf = layout.leaf_size - (64 if name == "fpn" else 0)
        ours = [layout.root_background, layout.root_size, layout.table_stride, layout.root_tile_size]
        ours += [layout.upper_table, layout.upper_size, layout.lower_table, layout.lower_size, leaf]
        assert ours == [row[i] for i in columns], name


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_voxel_sizes_neither_overflow_nor_vanish(scale):
    assert voxel_size_of(scale * ROTATED) == pytest.approx([0.1 * scale] * 3, rel=1e-14)


def test_headers_have_the_sizes_of_the_format():
    assert (GRID_DATA.itemsize, TREE_DATA.itemsize, FILE_HEADER.itemsize, FILE_METADATA.itemsize) == (672, 64, 16, 176)


@pytest.mark.parametrize("codec", CODECS)
def test_several_grids_come_back_bit_for_bit(tmp_path, codec):
    volumes = [sphere(12.0, name="a"), sphere(5.0, (-4096, 7, 9000), name="b", transform=ROTATED), sphere(3.0, name="")]
    before = [volume.nanovdb.copy() for volume in volumes]
    path = tmp_path / "x.nvdb"
    write(path, volumes, codec=codec)
    grids = read(path)
    assert [grid.name for grid in grids] == names(path) == ["a", "b", ""]
    for volume, old, grid in zip(volumes, before, grids, strict=True):
        assert np.array_equal(volume.nanovdb, old)
        assert np.array_equal(grid.buffer[736:], old[736:])
        assert np.array_equal(grid.buffer[16:736], old[16:736])
        assert grid.checksum == "full"
        assert grid.buffer.ctypes.data % 32 == 0
    assert [grid.name for grid in read(path, [2, 0])] == ["", "a"]


@pytest.mark.parametrize("codec", CODECS)
def test_inspect_says_what_loading_says(tmp_path, codec):
    volumes = [sphere(40.0, name="large"), sphere(5.0, name="small", transform=ROTATED)]
    write(tmp_path / "x.nvdb", volumes, codec=codec)
    for info, volume in zip(inspect(tmp_path / "x.nvdb"), volumes, strict=True):
        for field in dataclasses.fields(info):
            assert np.array_equal(getattr(info, field.name), getattr(volume.info, field.name)), field.name


@pytest.mark.parametrize("codec", CODECS)
def test_warp_loads_what_is_written(tmp_path, codec):
    volume = sphere(12.0, transform=ROTATED)
    write(tmp_path / "x.nvdb", [volume], codec=codec)
    with open(tmp_path / "x.nvdb", "rb") as file:
        loaded = wp.Volume.load_from_nvdb(file, device="cpu")
    assert np.array_equal(loaded.array().numpy()[736:], volume.nanovdb[736:])


@pytest.mark.parametrize("codec", CODECS)
def test_nanovdb_validate_accepts_what_is_written(tmp_path, codec):
    path = tmp_path / "x.nvdb"
    rocks = read(ROCKS)[0]
    empty = build_float_grid(
        np.empty((0, 3), np.int32), np.empty((0, 512), np.float32), np.empty((0, 512), np.bool_),
        background=1.0, transform=np.eye(4), name="empty", grid_class="unknown", signed_fill=False,
    )  # fmt: skip
    volumes = [sphere(12.0), SparseVolume(rocks.buffer, info_of(rocks.buffer)), SparseVolume(empty, info_of(empty))]
    write(path, volumes, codec=codec)
    done = subprocess.run([tool("nanovdb_validate"), "-v", path], capture_output=True, text=True, check=False)
    assert done.stdout.count("passed") == 3, done.stdout + done.stderr


@pytest.mark.parametrize("codec", ["none", "zip", "blosc"])
def test_what_warp_saves_is_read(tmp_path, codec):
    # Its count of compressed bytes leaves the length words out.
    values = np.random.default_rng(5).random((20, 30, 17)).astype(np.float32)
    made = wp.Volume.load_from_numpy(values, min_world=(-1.0, 2.0, 3.0), voxel_size=0.1, bg_value=0.5, device="cpu")
    path = tmp_path / "warp.nvdb"
    made.save_to_nvdb(path, codec=codec)
    (grid,) = read(path)
    np.testing.assert_array_equal(grid.buffer, made.array().numpy())
    assert len(inspect(path)) == 1


def test_files_of_other_writers_are_read():
    grid = read(ROCKS)[0]
    info = info_of(grid.buffer, name=grid.name)
    assert (info.name, info.grid_type, info.grid_class, info.active_voxel_count) == (
        "surface",
        "float",
        "level set",
        308828,
    )
    assert grid.checksum == "partial"
    assert inspect(ROCKS)[0].active_voxel_count == 308828


@pytest.mark.slow
@pytest.mark.parametrize("quantized", ["fp4", "fp8", "fp16", "fpn"])
def test_quantized_grids_of_nanovdb_convert_are_read(tmp_path, quantized):
    vdb = tmp_path / "s.vdb"
    subprocess.run([tool("vdb_tool"), "-sphere", "r=1.0", "v=0.05", "-write", vdb], check=True, capture_output=True)
    out = tmp_path / "s.nvdb"
    subprocess.run(
        [
            tool("nanovdb_convert"),
            "-f",
            "--fpN" if quantized == "fpn" else f"--{quantized}",
            "--checksum",
            "full",
            vdb,
            out,
        ],
        check=True,
        capture_output=True,
    )
    grid = read(out)[0]
    info = info_of(grid.buffer)
    assert (info.grid_type, grid.checksum) == (quantized, "full")
    assert info.voxel_size == pytest.approx([0.05] * 3)
    write(tmp_path / "again.nvdb", [SparseVolume(grid.buffer, info)], codec="zip")
    assert np.array_equal(read(tmp_path / "again.nvdb")[0].buffer[736:], grid.buffer[736:])
    done = subprocess.run([tool("nanovdb_validate"), "-v", tmp_path / "again.nvdb"], capture_output=True, text=True)
    assert "passed" in done.stdout


def as_new_version(volume: SparseVolume, checksum: str) -> np.ndarray:
    """The same grid as NanoVDB 32.8 writes it."""
    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    grid = grid_header(buffer)
    grid["magic"], grid["version"] = MAGIC_GRID, 32 << 21 | 8 << 10
    grid["checksum"] = (full_checksum if checksum == "full" else partial_checksum)(buffer[:736], buffer)
    return buffer


@pytest.mark.parametrize("checksum", ["full", "partial"])
def test_checksums_of_later_versions_are_verified(tmp_path, checksum):
    buffer = as_new_version(sphere(8.0), checksum)
    assert checksum_mode(buffer) == checksum
    assert checksum_matches(buffer)
    # NanoVDB's definition, written out: headers, then a sum over the sums of 4096-byte blocks, the last one longer.
    assert int(grid_header(buffer)["checksum"]) & 0xFFFFFFFF == zlib.crc32(buffer[16:736])
    if checksum == "full":
        body = buffer[736:].tobytes()
        count = len(body) // 4096
        blocks = [body[4096 * i : 4096 * (i + 1) if i + 1 < count else None] for i in range(count)]
        sums = b"".join(struct.pack("<I", zlib.crc32(block)) for block in blocks)
        assert int(grid_header(buffer)["checksum"]) >> 32 == zlib.crc32(sums)
    buffer[4] ^= 0
    buffer[40] ^= 1
    assert not checksum_matches(buffer)


def test_raw_buffers_are_files_too(tmp_path):
    first, second = as_new_version(sphere(8.0, name="a"), "full"), as_new_version(sphere(4.0, name="b"), "full")
    for index, buffer in enumerate((first, second)):
        grid_header(buffer)["grid_index"], grid_header(buffer)["grid_count"] = index, 2
        grid_header(buffer)["checksum"] = full_checksum(buffer[:736], buffer)
    path = tmp_path / "raw.nvdb"
    path.write_bytes(first.tobytes() + second.tobytes())
    grids = read(path)
    assert [grid.name for grid in grids] == names(path) == ["a", "b"]
    for grid in grids:
        assert (int(grid_header(grid.buffer)["grid_index"]), int(grid_header(grid.buffer)["grid_count"])) == (0, 1)
        assert checksum_matches(grid.buffer)
        assert checksum_mode(grid.buffer) == "full"
    old = tmp_path / "old.nvdb"
    old.write_bytes(sphere(8.0, name="old").nanovdb.tobytes())
    assert [grid.name for grid in read(old)] == ["old"]


def test_grids_of_later_versions_are_stored_as_old_ones(tmp_path):
    buffer = as_new_version(sphere(8.0), "full")
    write(tmp_path / "x.nvdb", [SparseVolume(buffer, info_of(buffer))])
    assert int(grid_header(read(tmp_path / "x.nvdb")[0].buffer)["version"]) == 32 << 21 | 4 << 10 | 2
    assert int(grid_header(buffer)["magic"]) == MAGIC_GRID


def test_both_magic_numbers_of_files_are_read(tmp_path):
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)])
    data = bytearray(path.read_bytes())
    data[:8] = struct.pack("<Q", MAGIC_FILE)
    path.write_bytes(data)
    assert names(path) == ["sphere"]
    assert len(read(path)) == 1


def test_all_segments_are_read(tmp_path):
    parts = []
    for i, codec in enumerate(CODECS):
        write(tmp_path / "part.nvdb", [sphere(4.0 + i, name=codec)], codec=codec)
        parts.append((tmp_path / "part.nvdb").read_bytes())
    (tmp_path / "x.nvdb").write_bytes(b"".join(parts))
    assert [grid.name for grid in read(tmp_path / "x.nvdb")] == list(CODECS)


def test_the_name_in_the_file_is_the_volumes(tmp_path):
    volume = sphere(4.0)
    renamed = dataclasses.replace(volume, info=dataclasses.replace(volume.info, name="Größe"))
    write(tmp_path / "x.nvdb", [renamed])
    grid = read(tmp_path / "x.nvdb")[0]
    assert (grid.name, info_of(grid.buffer).name) == ("Größe", "Größe")
    with pytest.raises(InputError, match="300 bytes"):
        write(tmp_path / "y.nvdb", [dataclasses.replace(volume, info=dataclasses.replace(volume.info, name="n" * 300))])
    assert not (tmp_path / "y.nvdb").exists()


@pytest.mark.parametrize("number", [0, 19, 20, 21, 22, 23, 27, 4000])
def test_grids_without_values_are_named_and_refused(tmp_path, number):
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)])
    data = bytearray(path.read_bytes())
    start = 16 + 176 + len("sphere") + 1
    struct.pack_into("<I", data, start + 636, number)
    path.write_bytes(data)
    name = GRID_TYPES[number] if number < len(GRID_TYPES) else f"number {number}"
    with pytest.raises(UnsupportedGridError, match=name):
        read(path)
    assert inspect(path)[0].grid_type == name
    with pytest.raises(UnsupportedGridError, match=name):
        check_grid(np.frombuffer(bytes(data[start:]), np.uint8).copy(), "grid")


def damaged(tmp_path: Path, at: int, new: bytes, codec: str = "none") -> Path:
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)], codec=codec)
    data = bytearray(path.read_bytes())
    data[at : at + len(new)] = new
    path.write_bytes(data)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "new", "text"),
    [
        (0, b"whatever", "no .nvdb file"),
        (0, struct.pack(">Q", MAGIC_FILE), "big-endian"),
        (14, b"\x07\x00", "compression 7"),
        (16, struct.pack("<Q", 1 << 40), "claims"),
        (24, struct.pack("<Q", 1 << 40), "needs"),
        (16 + 136, struct.pack("<I", 1 << 30), "name"),
        (199, b"x", "magic number"),
        (199 + 32, struct.pack("<Q", 64), "header says"),
        (199 + 384, struct.pack("<d", float("nan")), "transform"),
        (199 + 632, struct.pack("<I", 77), "grid class 77"),
        (199 + 672, struct.pack("<Q", 1 << 50), "leaf nodes"),
        (199 + 672 + 24, struct.pack("<Q", 63), "root nodes"),
        (199 + 672 + 32, struct.pack("<I", 1 << 30), "leaf nodes"),
        (199 + 736 + 24, struct.pack("<I", 1 << 30), "tiles of the root"),
        (199 + 736 + 64 + 8, struct.pack("<q", 12345), "upper node"),
        (199 + 648, struct.pack("<I", 3), "blind data"),
        (199 + 50, b"changed", "checksum"),
    ],
)
def test_damage_is_named(tmp_path, at, new, text):
    path = damaged(tmp_path, at, new)
    with pytest.raises(FileFormatError, match=text) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_other_major_versions_are_refused(tmp_path):
    with pytest.raises(UnsupportedGridError, match=r"31\.0\.0"):
        read(damaged(tmp_path, 8, struct.pack("<I", 31 << 21)))
    with pytest.raises(UnsupportedGridError, match=r"33\.1\.0"):
        read(damaged(tmp_path, 199 + 16, struct.pack("<I", 33 << 21 | 1 << 10)))


def test_nodes_out_of_order_are_refused(tmp_path):
    with pytest.raises(UnsupportedGridError, match="breadth-first"):
        read(damaged(tmp_path, 199 + 20, struct.pack("<I", 0)))


@pytest.mark.parametrize("shift", [2144, -2144, 32, 1 << 40, -(1 << 62)])
@pytest.mark.parametrize("level", ["lower", "upper"])
def test_offsets_to_children_are_checked(shift, level):
    buffer = sphere(12.0).nanovdb.copy()
    layout = require_supported(buffer, "x")
    tree = buffer[672:736].view(TREE_DATA)[0]
    begin = 672 + int(tree["node_offset"][1 if level == "lower" else 2])
    table, masks = (layout.lower_table, 512) if level == "lower" else (layout.upper_table, 4096)
    slot = int(np.flatnonzero(np.unpackbits(buffer[begin + 32 + masks : begin + 32 + 2 * masks], bitorder="little"))[0])
    at = begin + table + 8 * slot
    buffer[at : at + 8].view("<i8")[0] += shift
    with pytest.raises(FileFormatError):
        check_grid(buffer, "x")


def test_a_child_mask_that_calls_a_value_an_offset_is_refused():
    buffer = sphere(12.0).nanovdb.copy()
    begin = 672 + int(buffer[672:736].view(TREE_DATA)[0]["node_offset"][1])
    buffer[begin + 544 : begin + 544 + 512] = 255
    with pytest.raises(FileFormatError):
        check_grid(buffer, "x")


@pytest.mark.parametrize("codec", ["zip", "blosc"])
def test_compressed_bytes_that_do_not_decompress_are_refused(tmp_path, codec):
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)], codec=codec)
    data = bytearray(path.read_bytes())
    for at in (199, 199 + 9, 199 + 30, len(data) // 2, len(data) - 3):
        broken = bytearray(data)
        broken[at : at + 3] = bytes(b ^ 0x5A for b in broken[at : at + 3])
        path.write_bytes(broken)
        with pytest.raises((FileFormatError, UnsupportedGridError)):
            read(path)


@pytest.mark.parametrize("codec", CODECS)
def test_trailing_bytes_are_refused(tmp_path, codec):
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)], codec=codec)
    path.write_bytes(path.read_bytes() + b"left over")
    with pytest.raises(FileFormatError, match="9 bytes"):
        read(path)


@pytest.mark.slow
def test_zip_bombs_do_not_grow(tmp_path):
    write(tmp_path / "x.nvdb", [sphere(4.0)], codec="zip")
    data = bytearray((tmp_path / "x.nvdb").read_bytes())
    bomb = zlib.compress(bytes(100_000_000), 9)
    # Declared honestly it is refused for its first bytes, declared too small for its length.
    for declared, head in ((100_000_000, b""), (len(sphere(4.0).nanovdb), sphere(4.0).nanovdb.tobytes())):
        packed = bomb if not head else zlib.compress(head + bytes(100_000_000), 9)
        block = data[:199] + struct.pack("<Q", len(packed)) + packed
        struct.pack_into("<QQ", block, 16, declared, len(packed) + 8)
        (tmp_path / "bomb.nvdb").write_bytes(block)
        with pytest.raises(FileFormatError):
            read(tmp_path / "bomb.nvdb")


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(FileAccessError, match="no such file"):
        read(tmp_path / "missing.nvdb")
    (tmp_path / "empty.nvdb").touch()
    with pytest.raises(FileFormatError, match="empty"):
        read(tmp_path / "empty.nvdb")
    (tmp_path / "text.nvdb").write_text("# vtk DataFile Version 3.0\n" * 100)
    with pytest.raises(FileFormatError, match=r"no \.nvdb file"):
        names(tmp_path / "text.nvdb")


def test_writing_refuses_what_it_cannot_write(tmp_path):
    with pytest.raises(InputError, match="codec"):
        write(tmp_path / "x.nvdb", [sphere(4.0)], codec="lzma")
    with pytest.raises(InputError, match="no volumes"):
        write(tmp_path / "x.nvdb", [])
    with pytest.raises(FileAccessError):
        write(tmp_path / "missing" / "x.nvdb", [sphere(4.0)])
    volume = sphere(4.0)
    with pytest.raises(InputError, match=r"volumes\[1\]"):
        write(tmp_path / "x.nvdb", [volume, SparseVolume(volume.nanovdb[:2000], volume.info)])
    assert list(tmp_path.iterdir()) == []


def test_without_blosc_the_package_is_named(tmp_path, monkeypatch):
    path = tmp_path / "x.nvdb"
    write(path, [sphere(4.0)], codec="blosc")
    monkeypatch.setitem(sys.modules, "blosc", None)
    for use in (lambda: read(path), lambda: inspect(path), lambda: write(path, [sphere(4.0)], codec="blosc")):
        with pytest.raises(MissingDependencyError, match="pip install blosc"):
            use()


def test_a_grid_larger_than_the_memory_is_refused(monkeypatch):
    def fail(size):
        raise MemoryError

    monkeypatch.setattr(nvdb_file, "aligned_buffer", fail)
    with pytest.raises(DeviceMemoryError, match="not to be had"):
        read(ROCKS)


def test_a_grid_over_the_limit_is_refused_before_it_is_read():
    size = sum(len(grid.buffer) for grid in read(ROCKS))
    with pytest.raises(DeviceMemoryError, match="raise memory_limit"):
        read(ROCKS, memory_limit=size // 2)
    assert sum(len(grid.buffer) for grid in read(ROCKS, memory_limit=2 * size)) == size
