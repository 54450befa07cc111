"""Chunks of zarr that unfold to more than their array says are refused before they are decompressed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.formats.images.zarr_image import MEASURES

zarr = pytest.importorskip("zarr")
numcodecs = pytest.importorskip("numcodecs")
codecs = pytest.importorskip("zarr.codecs")

CODECS = {
    "blosc": (2, numcodecs.Blosc()),
    "zstd": (2, numcodecs.Zstd()),
    "lz4": (2, numcodecs.LZ4()),
    "zlib": (2, numcodecs.Zlib()),
    "gzip": (2, numcodecs.GZip()),
    "bz2": (2, numcodecs.BZ2()),
    "lzma": (2, numcodecs.LZMA()),
    "blosc of zarr 3": (3, codecs.BloscCodec()),
    "gzip of zarr 3": (3, codecs.GzipCodec()),
    "zstd of zarr 3": (3, codecs.ZstdCodec(checksum=True)),
}


def write(path: Path, size: int, version: int, codec: Any, shards: bool = False, **options: Any) -> np.ndarray:
    """Voxels (size, size, size) in eight chunks."""
    options |= {"shape": (size,) * 3, "chunks": (size // 2,) * 3, "dtype": "float32", "zarr_format": version}
    values = np.arange(size**3, dtype=np.float32).reshape(options["shape"]) + 1.0
    shard = {"shards": options["shape"]} if shards else {}
    zarr.create_array(str(path), compressors=codec, **options, **shard)[:] = values
    return values


@pytest.mark.parametrize("shards", [False, True])
@pytest.mark.parametrize("name", CODECS)
def test_sound_chunks_are_read_and_larger_ones_are_not(tmp_path: Path, name: str, shards: bool) -> None:
    version, codec = CODECS[name]
    if shards and version == 2:
        pytest.skip("zarr 2 has no shards")
    path, larger = tmp_path / "a.zarr", tmp_path / "larger.zarr"
    values = write(path, 16, version, codec, shards)
    assert np.array_equal(gk.volume.to_dense(gk.volume.load(path), device="cpu").values, values)
    write(larger, 80, version, codec, shards)
    for chunk in larger.rglob("*"):
        if chunk.is_file() and chunk.name not in (".zarray", ".zattrs", "zarr.json"):
            shutil.copy(chunk, path / chunk.relative_to(larger))
    with pytest.raises(gk.FileFormatError, match=r"a\.zarr: chunk \S+ unfolds to more than the 133120 bytes that"):
        gk.volume.load(path)


def test_numbers_may_be_stored_wider(tmp_path: Path) -> None:
    filters = [numcodecs.Delta("f4", astype="f8")]
    values = write(tmp_path / "a.zarr", 64, 2, numcodecs.Zlib(), filters=filters)
    assert np.array_equal(gk.volume.to_dense(gk.volume.load(tmp_path / "a.zarr"), device="cpu").values, values)


def test_what_is_compressed_twice_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.zarr", 16, 2, numcodecs.Zlib(), filters=[numcodecs.BZ2()])
    with pytest.raises(gk.FileFormatError, match=r"a\.zarr: is compressed by bz2 and zlib, which geokit cannot bound"):
        gk.volume.load(tmp_path / "a.zarr")


def test_frames_of_zstd_that_do_not_state_their_size() -> None:
    head, block = bytes.fromhex("28b52ffd0058"), (131072 << 3 | 1 << 1).to_bytes(3, "little") + b"x"
    last = (131072 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"x"
    frame = head + 79 * block + last
    assert MEASURES["zstd"](frame, 0) == 10 << 17
    assert MEASURES["zstd"](frame * 2, 0) == 20 << 17
    assert len(numcodecs.Zstd().decode(frame)) == 80 << 17
