"""Loading the part of a .nvdb in a box: the volume is that of ``clip``, and no other node is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.core.memory import available_memory
from geokit.errors import DeviceMemoryError, FileFormatError, GeokitError, InputError
from geokit.volume import SparseVolume
from geokit.volume.nanovdb.file import FILE_HEADER, FILE_METADATA
from geokit.volume.nanovdb.nodes import NodeLevel, grid_nodes
from geokit.volume.tree.typed_tree import VALUE_TYPES
from tests.support.effort import of_all
from tests.support.random_grids import random_grid

BOXES = [
    [[0.0, 0.0, 0.0], [0.9, 0.9, 0.9]],
    [[-0.31, 0.2, -1.0], [-0.3, 0.6, 1.0]],
    [[-1e300] * 3, [1e300] * 3],
    [[50.0] * 3, [60.0] * 3],
]


@pytest.fixture(scope="module")
def two_tori(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of two level sets on both sides of the origin, not compressed."""
    path = tmp_path_factory.mktemp("part") / "tori.nvdb"
    torus = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.02, name="torus", device="cpu")
    move = np.eye(4)
    move[:3, 3] = [-90.0, 0.0, 5.0]
    moved = gk.mesh.transform(gk.mesh.torus(), move)
    gk.volume.save(path, torus, gk.volume.from_mesh(moved, voxel_size=0.02, name="far", device="cpu"))
    return path


def require_same(part: SparseVolume, whole: SparseVolume) -> None:
    assert part.nanovdb.tobytes() == whole.nanovdb.tobytes()
    assert part.info.name == whole.info.name
    assert dict(part.info.metadata) == dict(whole.info.metadata)


@pytest.mark.slow
@pytest.mark.parametrize("grid_type", VALUE_TYPES)
@pytest.mark.parametrize("seed", of_all([1], [0, 1]))
def test_of_every_type(grid_type: str, seed: int, tmp_path: Path) -> None:
    volume = random_grid(grid_type, seed).volume
    gk.volume.save(tmp_path / "a.nvdb", volume)
    low, high = volume.info.world_bounds
    rng = np.random.default_rng(seed)
    boxes = [np.sort(rng.uniform(low, high, (2, 3)), axis=0) for _ in range(of_all(2, 4))]
    for box in [*boxes, *BOXES]:
        require_same(gk.volume.load(tmp_path / "a.nvdb", bounds=box), gk.volume.clip(volume, box))


@pytest.mark.parametrize("codec", ["none", "zip", "blosc"])
@pytest.mark.parametrize("kind", ["fp4", "fp8", "fp16", "fpn"])
def test_of_quantized_and_compressed_grids(kind: str, codec: str, two_tori: Path, tmp_path: Path) -> None:
    coded = gk.volume.quantize(gk.volume.load(two_tori, grid="far"), kind, tolerance=0.001 if kind == "fpn" else None)
    gk.volume.save(tmp_path / "a.nvdb", coded, codec=codec)
    box = [[-90.5, -0.3, 4.0], [-89.0, 2.0, 5.05]]
    part = gk.volume.load(tmp_path / "a.nvdb", bounds=box)
    assert part.info.active_voxel_count > 1000
    require_same(part, gk.volume.clip(coded, box))


@pytest.mark.parametrize("suffix", [".vdb", ".vti"])
def test_of_other_files(suffix: str, two_tori: Path, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    gk.volume.save(path, gk.volume.load(two_tori, grid="torus"))
    box = [[0.0, 0.0, -1.0], [2.0, 2.0, 1.0]]
    whole = gk.volume.load(path)
    part = gk.volume.load(path, bounds=box)
    assert 0 < part.info.active_voxel_count < whole.info.active_voxel_count
    require_same(part, gk.volume.clip(whole, box))


def test_under_a_rotated_and_mirrored_transform(tmp_path: Path) -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    transform = np.eye(4)
    transform[:3, :3] = turn @ np.diag([0.1, -0.2, 0.3])
    transform[:3, 3] = [1000.0, -7.0, 0.2]
    values = np.random.default_rng(4).uniform(1.0, 2.0, (60, 40, 50)).astype(np.float32)
    volume = gk.volume.from_dense(values, transform=transform)
    gk.volume.save(tmp_path / "a.nvdb", volume)
    for low, high in [((0, 0, 0), (10, 10, 10)), ((20.5, 13.0, 7.0), (33.0, 39.0, 12.1))]:
        corners = np.array([low, high]) @ transform[:3, :3].T + transform[:3, 3]
        box = np.sort(corners, axis=0)
        part = gk.volume.load(tmp_path / "a.nvdb", bounds=box)
        assert part.info.active_voxel_count > 100
        require_same(part, gk.volume.clip(volume, box))


def places_in_file(data: bytearray, level: str) -> tuple[NodeLevel, int]:
    """Nodes of a level of the first grid, as views on the bytes of the file, and where that grid starts in it."""
    header = np.frombuffer(data, FILE_HEADER, 1)[0]
    start = FILE_HEADER.itemsize
    for _ in range(int(header["grid_count"])):
        start += FILE_METADATA.itemsize + int(np.frombuffer(data, FILE_METADATA, 1, start)[0]["name_size"])
    size = int(np.frombuffer(data, FILE_METADATA, 1, FILE_HEADER.itemsize)[0]["grid_size"])
    return getattr(grid_nodes(np.frombuffer(data, np.uint8, size, start)), level), start


def test_other_leaves_are_not_read(two_tori: Path, tmp_path: Path) -> None:
    data = bytearray(two_tori.read_bytes())
    leaf, _ = places_in_file(data, "leaf")
    box = np.array([[0.5, 0.5, -0.2], [0.8, 0.8, 0.2]])
    outside = (leaf.origins * 0.02 > box[1] + 0.1).any(axis=1) | ((leaf.origins + 8) * 0.02 < box[0] - 0.1).any(axis=1)
    assert 10 < (~outside).sum() < 0.2 * len(outside)
    leaf.column(np.uint8, 0, leaf.size)[outside] = 255
    path = tmp_path / "a.nvdb"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a.nvdb"):
        gk.volume.load(path, grid="torus")
    part = gk.volume.load(path, grid="torus", bounds=box)
    require_same(part, gk.volume.clip(gk.volume.load(two_tori, grid="torus"), box))


def test_a_part_of_what_does_not_fit(two_tori: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = [[0.5, 0.5, -0.2], [0.6, 0.6, 0.2]]
    with pytest.raises(DeviceMemoryError, match="memory_limit"):
        gk.volume.load(two_tori, grid="torus", memory_limit=3 << 20)
    part = gk.volume.load(two_tori, grid="torus", memory_limit=3 << 20, bounds=box)
    assert part.info.active_voxel_count > 100
    with pytest.raises(DeviceMemoryError, match=r"tori.nvdb.* memory_limit"):
        gk.volume.load(two_tori, grid="torus", memory_limit=1 << 16, bounds=box)
    monkeypatch.setattr(available_memory, "available_host", lambda: 17 << 20)
    with pytest.raises(DeviceMemoryError, match="load: the part of grid 'torus'"):
        gk.volume.load(two_tori, grid="torus", bounds=[[-9.0] * 3, [9.0] * 3])


@pytest.mark.parametrize("level", ["upper", "lower"])
@pytest.mark.parametrize("change", ["between nodes", "far outside", "twice the same"])
def test_offsets_that_lie(level: str, change: str, two_tori: Path, tmp_path: Path) -> None:
    data = bytearray(two_tori.read_bytes())
    nodes, _ = places_in_file(data, level)
    node, slot, _ = nodes.links()
    first, second = (node[0], slot[0]), (node[1], slot[1])
    if change == "between nodes":
        nodes.child_offsets[first] += 32
    elif change == "far outside":
        nodes.child_offsets[first] = 1 << 62
    else:
        nodes.child_offsets[first] = nodes.child_offsets[second] + (node[1] - node[0]) * nodes.size
    path = tmp_path / "a.nvdb"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a.nvdb: grid 'torus'.* (offset does not lead|two offsets lead) to"):
        gk.volume.load(path, grid="torus", bounds=[[-9.0] * 3, [9.0] * 3])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(of_all(2, 4)))
def test_damage_is_named_or_not_met(seed: int, two_tori: Path, tmp_path: Path) -> None:
    sound = two_tori.read_bytes()
    rng = np.random.default_rng(seed)
    levels = [places_in_file(bytearray(sound), level) for level in ("root", "upper", "lower", "leaf")]
    path = tmp_path / "a.nvdb"
    for _ in range(60):
        data = bytearray(sound)
        for _ in range(rng.integers(1, 4)):
            nodes, start = levels[rng.integers(4)]
            at = start + nodes.begin + int(rng.integers(nodes.count)) * nodes.size + int(rng.integers(nodes.size))
            if rng.random() < 0.3:
                at = start + int(rng.integers(800))
            data[at : at + 8] = rng.integers(-1000, 1000, 1).tobytes() if rng.random() < 0.5 else rng.bytes(8)
        path.write_bytes(data)
        said = str(path)
        try:
            part = gk.volume.load(path, grid="torus", bounds=[[0.0, 0.0, -1.0], [1.5, 1.5, 1.0]])
            part.sample(np.zeros((1, 3)), device="cpu")
        except GeokitError as error:
            said = str(error)
        assert str(path) in said or "torus" in said, said


@pytest.mark.parametrize(
    "bounds", [[[0.0, 0.0, 0.0]], [[0.0, 0.0, np.nan], [1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]], "box"]
)
def test_bad_bounds(bounds: object, two_tori: Path) -> None:
    with pytest.raises(InputError, match="bounds"):
        gk.volume.load(two_tori, grid="torus", bounds=bounds)
