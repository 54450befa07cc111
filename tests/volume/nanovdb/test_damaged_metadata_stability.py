"""Damage to the metadata of .nvdb files ends in a named error or leaves metadata as it was; nothing else may change."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import FileFormatError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.file import inspect, read
from geokit.volume.nanovdb.header import BLIND_DATA, info_of
from geokit.volume.nanovdb.write import write
from tests.support.effort import of_all

METADATA = {"text": "some text", "number": 12345, "double": 0.125, "bytes": b"abc"}
ACCEPTED = (FileFormatError, UnsupportedGridError)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> tuple[bytes, int]:
    """A file, and where the blind data of its only grid starts."""
    volume = sphere(3.0)
    path = tmp_path_factory.mktemp("sound") / "x.nvdb"
    write(path, [SparseVolume(volume.nanovdb, info_of(volume.nanovdb, METADATA))])
    data = path.read_bytes()
    return data, data.index(b"geokit:metadata") - (BLIND_DATA.itemsize - 256)


def outcome(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    with contextlib.suppress(*ACCEPTED):
        inspect(path)
    try:
        grid = read(path)[0]
    except ACCEPTED as error:
        return "refused" if str(path) in str(error) else f"no path: {error}"
    if grid.metadata == METADATA:
        assert np.array_equal(grid.buffer[736:], sphere(3.0).nanovdb[736:])
        return "the same"
    return f"changed to {grid.metadata}"


@pytest.mark.slow
def test_no_flip_changes_metadata_unnoticed(tmp_path, sound):
    data, begin = sound
    entry, text = range(begin, begin + BLIND_DATA.itemsize), range(begin + BLIND_DATA.itemsize, len(data))
    found = {}
    for at in [*entry[:64], *entry[64::16], *text[:: of_all(2, 1)]]:
        for bit in (0x01, 0x80):
            broken = bytearray(data)
            broken[at] ^= bit
            found[at, bit] = outcome(tmp_path / "x.nvdb", bytes(broken))
    # A flipped name is another channel, which is none of geokit's; else it is refused or of no consequence.
    name = range(begin + 32, begin + 32 + len(b"geokit:metadata\0"))
    changed = {at for (at, _), result in found.items() if result.startswith("changed")}
    assert changed <= set(name)
    assert all(found[at, bit] == "changed to {}" for at in changed for bit in (0x01, 0x80))
    assert sum(result == "refused" for result in found.values()) > of_all(50, 100)
    assert not [result for result in found.values() if result.startswith("no path")]


def test_truncated_files_are_refused(tmp_path, sound):
    data, begin = sound
    for length in range(begin - 40, len(data), 11):
        assert outcome(tmp_path / "x.nvdb", data[:length]) == "refused"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(of_all(1, 3)))
@pytest.mark.parametrize("codec", ["none", "zip", "blosc"])
def test_random_damage_is_no_crash(tmp_path, seed, codec):
    volume = sphere(3.0)
    path = tmp_path / "x.nvdb"
    volumes = [SparseVolume(volume.nanovdb, info_of(volume.nanovdb, METADATA)), sphere(3.0, name="b")]
    write(path, volumes, codec=codec)
    data = path.read_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(30):
        broken = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 6)):
            broken[at] ^= int(rng.integers(1, 256))
        outcome(path, bytes(broken))
