"""Damaged .nvdb files end in a named error or in a sound grid: no crash, no hang, no memory beyond the file's."""

from __future__ import annotations

import resource
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog.sphere_volumes import sphere
from geokit.errors import FileFormatError, GeokitError, UnsupportedGridError
from geokit.volume import inspect, load_all
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.write import write
from tests.support.effort import of_all

CODECS = ("none", "zip", "blosc")
HEAD = 16 + 176 + len("sphere") + 1
ACCEPTED = (FileFormatError, UnsupportedGridError)
# A hang, not a time: a good run takes milliseconds, also on a busy machine far less than this.
SECONDS = 60.0


@pytest.fixture(scope="module", params=CODECS)
def sound(request, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("sound") / "x.nvdb"
    write(path, [sphere(6.0), sphere(3.0, (-4096, 0, 0), name="other")], codec=request.param)
    return path.read_bytes()


def outcome(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    start = time.perf_counter()
    results = []
    for function in (inspect, load_all):
        try:
            function(path)
            results.append("sound")
        except ACCEPTED as error:
            results.append(type(error).__name__ if str(path) in str(error) else f"no path: {error}")
    assert time.perf_counter() - start < SECONDS
    assert not [result for result in results if result.startswith("no path")]
    return results[1]


@pytest.mark.slow
def test_truncated_files_are_refused(tmp_path, sound):
    lengths = [*range(0, HEAD + 800, 37), *np.linspace(HEAD, len(sound) - 1, 30).astype(int)]
    assert {outcome(tmp_path / "x.nvdb", sound[:length]) for length in lengths} == {"FileFormatError"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(of_all(1, 3)))
def test_flipped_bytes_are_found(tmp_path, sound, seed):
    rng = np.random.default_rng(seed)
    for _ in range(40):
        data = bytearray(sound)
        # Half of the flips go into headers, where there is most to break.
        reach = HEAD + 1000 if rng.random() < 0.5 else len(data)
        for at in rng.integers(0, reach, rng.integers(1, 4)):
            data[at] ^= int(rng.integers(1, 256))
        outcome(tmp_path / "x.nvdb", bytes(data))


@pytest.mark.slow
def test_flips_of_an_uncompressed_grid_never_pass(tmp_path):
    # The full checksum covers every byte but the magic number, padding between nodes there is none.
    path = tmp_path / "x.nvdb"
    write(path, [sphere(6.0)])
    data = path.read_bytes()
    rng = np.random.default_rng(7)
    for at in [*range(HEAD, HEAD + 900, 13), *rng.integers(HEAD, len(data), 60)]:
        broken = bytearray(data)
        broken[at] ^= 0x10
        assert outcome(path, bytes(broken)) != "sound", at


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(of_all(1, 3)))
def test_what_passes_the_structural_checks_is_sound_for_warp_too(seed):
    """Without a checksum the structure alone decides; warp's own walk over the tree must agree."""
    wp.init()
    rng = np.random.default_rng(100 + seed)
    source = sphere(6.0).nanovdb
    validate = wp._src.context.runtime.core.wp_volume_validate_host
    nodes = 672 + source[672:736].view("<u8")[:4].astype(np.int64)
    passed = 0
    for _ in range(60):
        buffer = source.copy()
        region = rng.integers(0, 4)
        begin, end = ((0, 900), (nodes[2], nodes[2] + 9000), (nodes[1], nodes[1] + 9000), (736, 1000))[region]
        for at in rng.integers(begin, end, rng.integers(1, 6)):
            buffer[at] ^= int(rng.integers(1, 256))
        moved = sphere(6.0).nanovdb
        moved[:] = buffer
        try:
            check_grid(moved, "mutant")
        except ACCEPTED:
            continue
        passed += 1
        assert validate(moved.ctypes.data, moved.size) == 1
    assert passed > 0


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0" * 16,
        b"\0" * 5000,
        b"NanoVDB0",
        b"NanoVDB1" + b"\xff" * 800,
        b"NanoVDB2" + b"\xff" * 800,
        b"Mesh; not a grid\n" * 300,
        bytes(range(256)) * 20,
    ],
    ids=range(8),
)
def test_files_of_something_else_are_refused(tmp_path, data):
    with pytest.raises(ACCEPTED):
        load_all(_written(tmp_path, data))
    with pytest.raises(ACCEPTED):
        inspect(_written(tmp_path, data))


def test_a_grid_count_without_grids_is_refused(tmp_path, sound):
    data = bytearray(sound)
    data[12:14] = b"\xff\xff"
    assert outcome(tmp_path / "x.nvdb", bytes(data)) == "FileFormatError"


@pytest.mark.slow
def test_bombs_stay_small(tmp_path):
    """A megabyte that claims and inflates to a gigabyte is refused before the gigabyte is there."""
    packer = zlib.compressobj(1)
    packed = b"".join([packer.compress(bytes(1 << 24)) for _ in range(64)] + [packer.flush()])
    write(tmp_path / "s.nvdb", [sphere(3.0)], codec="zip")
    head = bytearray((tmp_path / "s.nvdb").read_bytes()[:HEAD])
    head[16:24] = (1 << 30).to_bytes(8, "little")
    head[24:32] = (len(packed) + 8).to_bytes(8, "little")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert outcome(tmp_path / "x.nvdb", bytes(head) + len(packed).to_bytes(8, "little") + packed) == "FileFormatError"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < 100_000_000


def test_every_error_is_geokits_own():
    assert all(issubclass(kind, GeokitError) for kind in ACCEPTED)


def _written(folder: Path, data: bytes) -> Path:
    (folder / "x.nvdb").write_bytes(data)
    return folder / "x.nvdb"
