"""Metadata in .nvdb files: there again after a round trip, invisible to other readers, refused where damaged."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import FileFormatError, InputError
from geokit.native import RawMetadata
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb import metadata as nvdb_metadata
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.checksum import checksum_matches, full_checksum, partial_checksum
from geokit.volume.nanovdb.file import inspect, read
from geokit.volume.nanovdb.header import BLIND_DATA, HEAD_SIZE, MAGIC_GRID, aligned_buffer, grid_header, info_of
from geokit.volume.nanovdb.metadata import body_with_metadata, metadata_of, without_metadata
from geokit.volume.nanovdb.write import write
from geokit.volume.retyped.from_channel import from_channel
from tests.support.nanovdb_validate import assert_validated, needs_validate

CODECS = ("none", "zip", "blosc")
RICH = {
    "text": 'a \u00fc \U0001f600 \udcff " \\ \n',
    "": "",
    "flag": True,
    "count": -(2**63),
    "large": 2**63 - 1,
    "double": 0.1,
    "negative zero": -0.0,
    "nan": np.nan,
    "infinite": np.inf,
    "single": np.float32(0.1),
    "small": np.int32(-7),
    "vector": (1.0, 2.5, -1e300),
    "indices": (1, 2, 3),
    "single vector": (np.float32(0.1), np.float32(0.2)),
    "matrix": ((1.0, 0.0, 0.0, 0.0),) * 4,
    "bytes": b"\x00\xff",
    "raw": RawMetadata("unheard of", b"\x01\x02"),
    "type": "looks like a tag",
}


def with_metadata(metadata, **options) -> SparseVolume:
    volume = sphere(6.0, **options)
    return SparseVolume(volume.nanovdb, info_of(volume.nanovdb, metadata))


def assert_same(found, expected):
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert type(found[name]) is type(value), name
        assert found[name] == value or (value != value and found[name] != found[name]), name
    assert str(found["negative zero"]) == "-0.0"


@pytest.mark.parametrize("codec", CODECS)
def test_every_kind_of_value_comes_back(tmp_path, codec):
    write(tmp_path / "x.nvdb", [with_metadata(RICH)], codec=codec)
    assert_same(read(tmp_path / "x.nvdb")[0].metadata, RICH)


@pytest.mark.slow
@pytest.mark.parametrize("codec", CODECS)
def test_the_grid_itself_stays_bit_for_bit(tmp_path, codec):
    volumes = [with_metadata({"n": 1}), with_metadata({}, name="plain"), with_metadata({"x": "y" * 5000}, name="long")]
    write(tmp_path / "with.nvdb", volumes, codec=codec)
    write(tmp_path / "without.nvdb", [SparseVolume(v.nanovdb, sphere(6.0, name=v.info.name).info) for v in volumes])
    for found, plain, volume in zip(
        read(tmp_path / "with.nvdb"), read(tmp_path / "without.nvdb"), volumes, strict=True
    ):
        assert found.metadata == volume.info.metadata
        assert np.array_equal(found.buffer, plain.buffer)
        assert found.checksum == "full"
        assert checksum_matches(found.buffer)
        assert found.buffer.ctypes.data % 32 == 0
        check_grid(found.buffer, "found")


def test_without_metadata_files_are_as_before(tmp_path):
    write(tmp_path / "x.nvdb", [sphere(6.0)])
    assert b"geokit:metadata" not in (tmp_path / "x.nvdb").read_bytes()


def test_inspect_reads_it_where_it_can(tmp_path):
    volumes = [with_metadata(RICH), with_metadata({}, name="plain")]
    write(tmp_path / "x.nvdb", volumes)
    first, second = inspect(tmp_path / "x.nvdb")
    assert_same(first.metadata, RICH)
    assert second.metadata == {}
    assert [first.byte_count, second.byte_count] == [len(v.nanovdb) for v in volumes]
    write(tmp_path / "x.nvdb", volumes, codec="zip")
    assert inspect(tmp_path / "x.nvdb")[0].metadata == {}


@needs_validate
@pytest.mark.parametrize("codec", CODECS)
def test_nanovdb_validate_accepts_it(tmp_path, codec):
    write(tmp_path / "x.nvdb", [with_metadata(RICH), with_metadata({"a": 1}, name="b")], codec=codec)
    assert_validated(tmp_path / "x.nvdb", 2)


@pytest.mark.parametrize("codec", CODECS)
def test_warp_passes_over_it(tmp_path, codec):
    write(tmp_path / "x.nvdb", [with_metadata(RICH)], codec=codec)
    with open(tmp_path / "x.nvdb", "rb") as file:
        loaded = wp.Volume.load_from_nvdb(file, device="cpu")
    nodes = sphere(6.0).nanovdb[HEAD_SIZE:]
    assert np.array_equal(loaded.array().numpy()[HEAD_SIZE : HEAD_SIZE + len(nodes)], nodes)


def with_blind_data(version_new: bool = False) -> SparseVolume:
    """A grid with two blocks of blind data of somebody else's, the second before the first."""
    plain = sphere(6.0).nanovdb
    size = len(plain)
    buffer = aligned_buffer(size + 2 * BLIND_DATA.itemsize + 64, zeroed=True)
    buffer[:size] = plain
    entries = buffer[size : size + 2 * BLIND_DATA.itemsize].view(BLIND_DATA)
    data = size + 2 * BLIND_DATA.itemsize
    buffer[data:] = np.arange(64)
    entries["offset"] = [data + 32 - size, data - size - BLIND_DATA.itemsize]
    entries["value_count"], entries["value_size"], entries["name"] = 32, 1, [b"one", b"two"]
    grid = grid_header(buffer)
    grid["blind_offset"], grid["blind_count"], grid["grid_size"] = size, 2, len(buffer)
    if version_new:
        grid["magic"], grid["version"] = MAGIC_GRID, 32 << 21 | 8 << 10
    grid["checksum"] = full_checksum(buffer[:HEAD_SIZE], buffer)
    return SparseVolume(buffer, info_of(buffer, {"mine": 1.5}))


@pytest.mark.parametrize("version_new", [False, True])
@pytest.mark.parametrize("codec", CODECS)
def test_blind_data_of_others_stays(tmp_path, version_new, codec):
    volume = with_blind_data(version_new)
    kept = volume.nanovdb.copy()
    write(tmp_path / "x.nvdb", [volume], codec=codec)
    assert np.array_equal(volume.nanovdb, kept)
    found = read(tmp_path / "x.nvdb")[0]
    assert found.metadata == {"mine": 1.5}
    assert np.array_equal(found.buffer, kept)
    raw = SparseVolume(found.buffer, info_of(found.buffer))
    write(tmp_path / "y.nvdb", [raw], codec=codec)
    assert np.array_equal(read(tmp_path / "y.nvdb")[0].buffer, kept)


def attached(metadata, volume=None) -> np.ndarray:
    volume = volume or sphere(6.0)
    head = volume.nanovdb[:HEAD_SIZE].copy()
    body = body_with_metadata(head, volume.nanovdb, metadata, "volume")
    whole = np.concatenate([head, *body])
    buffer = aligned_buffer(len(whole))
    buffer[:] = whole
    return buffer


def test_blind_data_of_others_keeps_its_place_in_the_file():
    buffer = attached({"mine": 1.5}, with_blind_data())
    check_grid(buffer, "attached")
    grid = grid_header(buffer)
    begin = int(grid["blind_offset"])
    entries = buffer[begin : begin + 3 * BLIND_DATA.itemsize].view(BLIND_DATA)
    assert [name.split(b"\0")[0] for name in entries["name"].tolist()] == [b"one", b"two", b"geokit:metadata"]
    for i, expected in enumerate([np.arange(32, 64), np.arange(32)]):
        start = begin + i * BLIND_DATA.itemsize + int(entries["offset"][i])
        assert buffer[start : start + 32].tolist() == expected.tolist()
    start = begin + 2 * BLIND_DATA.itemsize + int(entries["offset"][2])
    assert b'"mine":1.5' in buffer[start : start + int(entries["value_count"][2])].tobytes()


def test_a_channel_that_is_not_the_last_is_read_and_left():
    first = attached({"old": 1})
    both = attached({"new": 2}, SparseVolume(first, info_of(first)))
    assert metadata_of(both, "x")[0] == {"new": 2}
    grid = grid_header(both)
    begin = int(grid["blind_offset"])
    both[begin : begin + 2 * BLIND_DATA.itemsize].view(BLIND_DATA)["name"][1] = b"other"
    buffer, metadata = without_metadata(both, "x")
    assert metadata == {"old": 1}
    assert len(buffer) == len(both)


@pytest.mark.parametrize("offset", ["zero", "end"])
def test_the_header_is_as_it_was(offset):
    volume = sphere(6.0)
    grid_header(volume.nanovdb)["blind_offset"] = 0 if offset == "zero" else len(volume.nanovdb)
    grid_header(volume.nanovdb)["checksum"] = full_checksum(volume.nanovdb[:HEAD_SIZE], volume.nanovdb)
    buffer = attached({"a": 1}, volume)
    grid_header(buffer)["checksum"] = full_checksum(buffer[:HEAD_SIZE], buffer)
    found, _ = without_metadata(buffer, "x")
    assert np.array_equal(found, volume.nanovdb)


@pytest.mark.parametrize("mode", ["none", "partial"])
def test_checksums_of_other_kinds_stay_of_their_kind(mode):
    buffer = attached({"a": 1})
    grid_header(buffer)["checksum"] = 0
    if mode == "partial":
        grid_header(buffer)["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
    found, _ = without_metadata(buffer, "x")
    assert int(grid_header(found)["checksum"]) == (
        0 if mode == "none" else int(grid_header(sphere(6.0).nanovdb)["checksum"])
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"3",
        b"null",
        b"\xff\xfe",
        b"{}",
        b'{"blind_offset":"zero"}',
        b'{"blind_offset":"zero","metadata":[]}',
        b'{"blind_offset":"zero","metadata":{"a":null}}',
        b'{"blind_offset":"zero","metadata":{"a":[1]}}',
        b'{"blind_offset":"zero","metadata":{"a":NaN}}',
        b'{"blind_offset":"zero","metadata":{"a":1e999}}',
        b'{"blind_offset":"zero","metadata":{"a":9223372036854775808}}',
        b'{"blind_offset":"zero","metadata":{"a":{}}}',
        b'{"blind_offset":"zero","metadata":{"a":{"type":"float","hex":"zz"}}}',
        b'{"blind_offset":"zero","metadata":{"a":{"type":"float","hex":7}}}',
        b'{"blind_offset":"zero","metadata":{"a":{"type":7,"hex":""}}}',
        b'{"blind_offset":"zero","metadata":{"a":{"type":"float","hex":"","more":1}}}',
        b'{"blind_offset":7,"metadata":{}}',
        b'{"blind_offset":[],"metadata":{}}',
        b"[" * 100_000,
        b"1" * 100_000,
    ],
)
def test_damaged_text_is_refused(monkeypatch, text):
    monkeypatch.setattr(nvdb_metadata, "_encoded", lambda *_: text)
    buffer = attached({"a": 1})
    for look in (metadata_of, without_metadata):
        with pytest.raises(FileFormatError, match=r"^file: the grid is damaged"):
            look(buffer, "file")


def test_a_changed_text_is_refused_and_one_without_a_checksum_is_read():
    buffer = attached({"a": 1})
    begin = int(grid_header(buffer)["blind_offset"])
    entry = buffer[begin : begin + BLIND_DATA.itemsize].view(BLIND_DATA)
    text = buffer[begin + int(entry["offset"][0]) :]
    text[text.tobytes().index(b"1")] = ord("2")
    with pytest.raises(FileFormatError, match="checksum of its metadata"):
        metadata_of(buffer, "file")
    entry["name"] = b"geokit:metadata"
    assert metadata_of(buffer, "file")[0] == {"a": 2}


@pytest.mark.parametrize(
    ("field", "value"),
    [("offset", -(2**40)), ("offset", 2**40), ("value_count", 2**62), ("value_count", 17 << 20), ("value_size", 4)],
)
def test_damaged_entries_are_refused(field, value):
    buffer = attached({"a": 1})
    begin = int(grid_header(buffer)["blind_offset"])
    buffer[begin : begin + BLIND_DATA.itemsize].view(BLIND_DATA)[field] = value
    for look in (metadata_of, without_metadata):
        with pytest.raises(FileFormatError, match="metadata do not fit"):
            look(buffer, "file")


@pytest.mark.parametrize(("field", "value"), [("blind_offset", 8), ("blind_offset", 2**40), ("blind_count", 2**31)])
def test_damaged_headers_are_refused(field, value):
    buffer = attached({"a": 1})
    grid_header(buffer)[field] = value
    with pytest.raises(FileFormatError, match="blind data do not fit"):
        metadata_of(buffer, "file")


@pytest.mark.slow
def test_what_cannot_be_stored_is_refused(tmp_path):
    for bad in ({"a": object()}, {"a": 2**63}, {"a": [1, "x"]}):
        with pytest.raises(InputError, match="metadata 'a'"):
            write(tmp_path / "x.nvdb", [with_metadata(bad)])
    with pytest.raises(InputError, match="use at most"):
        write(tmp_path / "x.nvdb", [with_metadata({"a": "x" * (17 << 20)})])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("grid_type", ["index", "onindex"])
def test_channels_of_index_grids_stay(tmp_path, grid_type):
    grid = IndexGrid(grid_type, [("density", "float"), ("velocity", "vec3f")])
    volume = SparseVolume(grid.volume.nanovdb, info_of(grid.volume.nanovdb, {"mine": 1}))
    write(tmp_path / "x.nvdb", [volume])
    write(tmp_path / "y.nvdb", [grid.volume])
    found, plain = read(tmp_path / "x.nvdb")[0], read(tmp_path / "y.nvdb")[0]
    assert found.metadata == {"mine": 1}
    assert np.array_equal(found.buffer, plain.buffer)
    again = SparseVolume(found.buffer, info_of(found.buffer))
    assert np.array_equal(from_channel(again, "velocity").nanovdb, from_channel(grid.volume, "velocity").nanovdb)
