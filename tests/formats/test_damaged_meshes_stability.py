"""Files damaged at random: each loads as a sound mesh or is refused by name; nothing crashes, hangs or prints.

The envelope: geokit's own readers meet many mutants of each format in this process; the readers of other libraries meet
a few each, in the process that guards against what they do.
"""

from __future__ import annotations

import random
import time

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support.attributed import painted
from tests.support.effort import of_all

MUTANTS = of_all(100, 300)

# Attributes that damage makes unusable are left out with a warning.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

MESH = mesh_catalog.l_profile()
# A hang, not a time: a good run takes milliseconds, also on a busy machine far less than this.
SLOWEST_SECONDS = 60.0


def mutate(data: bytes, seed: int) -> bytes:
    chance = random.Random(seed)
    kind = seed % 6
    copy = bytearray(data)
    if kind == 0:
        return bytes(copy[: chance.randrange(1, len(copy))])
    if kind == 1:
        copy[chance.randrange(len(copy))] ^= 1 << chance.randrange(8)
    elif kind == 2:
        for _ in range(10):
            copy[chance.randrange(len(copy))] = chance.randrange(256)
    elif kind == 3:
        at = chance.randrange(len(copy))
        del copy[at : at + chance.randrange(1, 40)]
    elif kind == 4:
        at, length = chance.randrange(len(copy)), chance.randrange(1, 40)
        copy[at:at] = copy[at : at + length]
    else:
        at = chance.randrange(len(copy))
        copy[at : at + 4] = chance.choice(
            [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"-999", b"1e99", b"nan "]
        )
    return bytes(copy)


def survives(path) -> bool:
    """Whether the file loads; what loads must be a mesh, and what does not must be named."""
    start = time.monotonic()
    mesh, refusal = None, ""
    try:
        mesh = gk.mesh.load(path)
    except gk.FileFormatError as error:
        refusal = str(error)
    if path.suffix in OWN:
        assert time.monotonic() - start < SLOWEST_SECONDS
    if mesh is None:
        assert str(path) in refusal
        assert "\n" not in refusal
        return False
    assert len(mesh.faces) > 0
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
    gk.mesh.audit(mesh)
    return True


def quads_as_ply() -> bytes:
    return (
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 2\n"
    )


def ascii_stl() -> bytes:
    lines = []
    for triangle in MESH.vertices[MESH.faces].tolist():
        corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle)
        lines.append(f"facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    return f"solid a\n{''.join(lines)}endsolid a\n".encode()


OWN = {".obj", ".off", ".ply", ".stl"}
PAINTED = {f"painted.{kind}": None for kind in ("obj", "off", "ply")}
SOURCES = {"obj": None, "off": None, "ply": None, "stl": None, "ascii.ply": quads_as_ply, "ascii.stl": ascii_stl}
SOURCES |= PAINTED


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
def test_mutants(tmp_path, source):
    make = SOURCES[source]
    path = tmp_path / f"mutant.{source}"
    if make is None:
        gk.mesh.save(path, painted(MESH) if source in PAINTED else MESH)
    else:
        path.write_bytes(make())
    whole = path.read_bytes()
    assert survives(path)
    loaded = 0
    for seed in range(MUTANTS):
        path.write_bytes(mutate(whole, seed))
        loaded += survives(path)
    # Most damage is found; some (a changed digit) makes another mesh, which nothing can tell.
    assert loaded < 0.8 * MUTANTS


# .obj declares nothing: what is there counts.
@pytest.mark.parametrize("source", ["off", "ply", "stl", "ascii.ply", "ascii.stl"])
def test_every_truncation_is_found(tmp_path, source):
    make = SOURCES[source]
    path = tmp_path / f"cut.{source}"
    if make is None:
        gk.mesh.save(path, MESH)
    else:
        path.write_bytes(make())
    whole = path.read_bytes()
    # Text cut within its last number ends with another number.
    end = len(whole) if source in ("ply", "stl") else whole.rstrip().rindex(b" ")
    for length in range(1, end, max(1, len(whole) // 150)):
        path.write_bytes(whole[:length])
        assert not survives(path), length


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["painted.glb", "painted.usdc", "painted.vtp", "glb", "3mf", "vtk", "vtp", "vtu", "msh", "xdmf", "usda", "usdc"],
)
def test_mutants_of_other_formats(tmp_path, kind, capfd):
    path = tmp_path / f"mutant.{kind}"
    gk.mesh.save(path, painted(MESH) if kind.startswith("painted") else MESH)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert not survives(path)
    for seed in (13,) if kind in ("glb", "3mf") else (13, 14, 17):
        path.write_bytes(mutate(whole, seed))
        survives(path)
    path.write_bytes(b"solid ground\n" * 30)
    assert not survives(path)
    assert capfd.readouterr() == ("", "")
