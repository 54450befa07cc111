"""Point files damaged at random: each loads as sound points or is refused by name; nothing crashes, hangs or prints.

The envelope: many mutants and 60 truncations of each format that is read in this process; a few of .vtp and .laz, whose
readers have a process of their own, because they end that of whoever calls them.
"""

from __future__ import annotations

import importlib.util
import random
import struct
import time
import tracemalloc

import numpy as np
import pytest

import geokit as gk
from geokit.points._io import load, save
from tests.support.effort import of_all

MUTANTS = of_all(70, 200)

# Lines of an .obj that damage makes unknown are left out with a warning.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

RANDOM = np.random.default_rng(3)
POINTS = RANDOM.normal(size=(40, 3))
RGB = RANDOM.integers(0, 256, (40, 3)).astype(np.uint8)
DATA = {"normals": RANDOM.normal(size=(40, 3)), "rgb": RGB, "id": np.arange(40, dtype=np.int32)}
# A hang, not a time: a good run takes milliseconds, also on a busy machine far less than this.
SLOWEST_SECONDS = 60.0
# What a file of some kilobytes may make the process allocate: far less than what the damaged sizes below ask for.
MOST_BYTES = 64 << 20

ASCII_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 40\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    + "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist())
)
OBJ = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist())
# A name for each variant, and what is saved; text is there as it is.
SOURCES = {
    "a.pcd": {"data": DATA},
    "ascii.pcd": {"data": DATA, "encoding": "ascii"},
    "compressed.pcd": {"data": DATA, "encoding": "binary_compressed"},
    "a.pts": {"data": {"rgb": RGB}},
    "a.xyz": {"data": DATA},
    "a.csv": {"data": DATA},
    "a.ply": {"data": DATA},
    "ascii.ply": ASCII_PLY,
    "a.obj": OBJ,
    "a.npz": {"data": DATA},
    "a.npy": None,
    "a.las": {"data": DATA},
}
# These declare how much they hold; the others end where they end.
COUNTED = ["a.pcd", "ascii.pcd", "compressed.pcd", "a.pts", "a.ply", "ascii.ply", "a.npz", "a.npy", "a.las"]


def make(name, folder):
    path = folder / name
    if name.endswith(".las"):
        pytest.importorskip("laspy")
    source = SOURCES[name]
    if source is None:
        np.save(path, POINTS)
    elif isinstance(source, str):
        path.write_text(source)
    else:
        save(path, POINTS, **source)
    return path, path.read_bytes()


def mutate(data: bytes, seed: int) -> bytes:
    chance = random.Random(seed)
    kind = seed % 6
    copy = bytearray(data)
    at = chance.randrange(len(copy))
    if kind == 0:
        return bytes(copy[: max(at, 1)])
    if kind == 1:
        copy[at] ^= 1 << chance.randrange(8)
    elif kind == 2:
        for _ in range(10):
            copy[chance.randrange(len(copy))] = chance.randrange(256)
    elif kind == 3:
        del copy[at : at + chance.randrange(1, 40)]
    elif kind == 4:
        copy[at:at] = copy[at : at + chance.randrange(1, 40)]
    else:
        # Most of what can go wrong stands at the beginning.
        at = chance.randrange(min(len(copy), 400))
        copy[at : at + 4] = chance.choice(
            [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"-999", b"1e99", b"nan ", b"9999"]
        )
    return bytes(copy)


def survives(path) -> bool:
    """Whether the file loads; what loads must be sound points, and what does not must be named in one line."""
    start = time.monotonic()
    cloud, refusal = None, ""
    try:
        cloud = load(path)
    except (gk.FileFormatError, gk.DeviceMemoryError) as error:
        refusal = str(error)
    assert time.monotonic() - start < SLOWEST_SECONDS
    if cloud is None:
        assert str(path) in refusal
        assert "\n" not in refusal
        return False
    assert np.isfinite(cloud.points).all()
    assert all(len(values) == len(cloud) for values in cloud.data.values())
    return True


@pytest.mark.slow
@pytest.mark.parametrize("name", SOURCES)
def test_mutants(name, tmp_path, capfd):
    path, whole = make(name, tmp_path)
    assert survives(path)
    loaded = 0
    for seed in range(MUTANTS):
        path.write_bytes(mutate(whole, seed))
        loaded += survives(path)
    # Much damage is found; some (a changed digit, a bit of a coordinate) makes other points, which nothing can tell.
    assert loaded < 0.8 * MUTANTS
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", COUNTED)
def test_every_truncation_is_found(name, tmp_path):
    path, whole = make(name, tmp_path)
    # Text cut within its last number ends with another number.
    text = name.startswith("ascii") or name.endswith(".pts")
    end = whole.rstrip().rindex(b" ") if text else len(whole)
    for length in [*range(1, end, max(1, end // 60)), end - 1]:
        path.write_bytes(whole[:length])
        assert not survives(path), length


def test_sizes_that_would_fill_the_memory(tmp_path):
    """Files of some hundred bytes that declare billions of points, or fields of gigabytes."""
    pcd = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {d}\n"
    many, body = 4_000_000_000, bytes(120)
    packed = struct.pack("<II", 100, 4_294_967_292) + body
    wide = pcd.replace("FIELDS x y z", "FIELDS x y z h").replace("4 4 4", "4 4 4 8").replace("F F F", "F F F F")
    wide = wide.replace("1 1 1", "1 1 1 100000000")
    ply = "ply\nformat {f} 1.0\nelement vertex 4000000000\n" + "".join(f"property double {a}\n" for a in "xyz")
    npy = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (4000000000, 3), }".ljust(117)
    files = {
        "binary.pcd": pcd.format(n=many, d="binary").encode() + body,
        "ascii.pcd": pcd.format(n=many, d="ascii").encode() + b"1 2 3\n",
        "compressed.pcd": pcd.format(n=357_913_941, d="binary_compressed").encode() + packed,
        "wide.pcd": wide.format(n=2, d="binary").encode() + body,
        "none.pcd": wide.format(n=0, d="binary_compressed").encode() + struct.pack("<II", 0, 0),
        "a.pts": b"4000000000\n1 2 3\n",
        "binary.ply": ply.format(f="binary_little_endian").encode() + b"end_header\n" + body,
        "ascii.ply": ply.format(f="ascii").encode() + b"end_header\n1 2 3\n",
        "a.npy": npy + b"\n" + body,
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        tracemalloc.start()
        loads = survives(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert loads == (name == "none.pcd"), name
        assert peak < MOST_BYTES or name == "a.npy", (name, peak)  # numpy asks for it all, and gives it back unused


@pytest.mark.slow
def test_vtp_has_a_process_of_its_own(tmp_path, capfd):
    path = tmp_path / "a.vtp"
    save(path, POINTS, data=DATA)
    whole = path.read_bytes()
    assert survives(path)
    # VTK allocates as many points as the file says there are, and is ended when it cannot.
    many = whole.replace(b'NumberOfPoints="40"', b'NumberOfPoints="4000000000000"')
    assert many != whole
    truncated = whole[: len(whole) // 2] + b"</VTKFile>\n"
    for damage in [whole[:-20], truncated, many]:
        path.write_bytes(damage)
        assert not survives(path)
    for seed in (2, 5):
        path.write_bytes(mutate(whole, seed))
        survives(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.skipif(
    not (importlib.util.find_spec("laspy") and importlib.util.find_spec("lazrs")), reason="needs laspy and lazrs"
)
def test_laz_has_a_process_of_its_own(tmp_path, capfd):
    path = tmp_path / "a.laz"
    save(path, POINTS, data=DATA)
    whole = path.read_bytes()
    assert survives(path)
    # The table of chunks says how long a chunk is: the decompressor allocates whatever stands there.
    start = int.from_bytes(whole[96:100], "little")
    table = int.from_bytes(whole[start : start + 8], "little")
    refused = 0
    for damage in [
        whole[: len(whole) // 2],
        whole[: table + 8] + b"\xff\xff\xff\xff" + whole[table + 12 :],
        whole[: table + 8] + bytes(4) + whole[table + 12 :],
        whole[:247] + struct.pack("<Q", 1 << 45) + whole[255:],
        *(mutate(whole, seed) for seed in (2, 8)),
    ]:
        path.write_bytes(damage)
        refused += not survives(path)
    assert refused >= 4
    assert capfd.readouterr() == ("", "")
