"""Makes the sample files beside this script. Seeded: the same content at each run.

python data/samples/generate.py            all samples
python data/samples/generate.py meshes     without the volumes, which need geokit's OpenVDB extension
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import geokit as gk

FOLDER = Path(__file__).resolve().parent
SEED = 20240229

TORUS_MAJOR, TORUS_MINOR = 1.0, 0.4
# A power of two: exact in the float32 in which transforms reach the grid.
SMOKE_VOXEL = 0.0625


def torus_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance (N,) from points (N, 3) to the torus of torus.ply, negative inside."""
    ring = np.hypot(points[:, 0], points[:, 1]) - TORUS_MAJOR
    return np.hypot(ring, points[:, 2]) - TORUS_MINOR


def torus(around: int = 160, across: int = 80) -> gk.mesh.TriangleMesh:
    """Smooth and closed; each vertex lies on the torus of :func:`torus_distance` around the z axis."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b = 2.0 * np.pi * i / around, 2.0 * np.pi * j / across
    ring = TORUS_MAJOR + TORUS_MINOR * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), TORUS_MINOR * np.sin(b)], axis=1)
    corners = [(i + di) % around * across + (j + dj) % across for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = [np.stack([corners[k] for k in triangle], axis=1) for triangle in ((0, 1, 2), (0, 2, 3))]
    return gk.mesh.TriangleMesh(vertices, np.concatenate(faces), name="torus")


def bracket(hole_corners: int = 32) -> gk.mesh.TriangleMesh:
    """Sharp edges, closed: an L of two plates 40 x 30 x 4 and 26 x 30 x 4 [mm] with a hole through the lower one.

    The lower plate is z in [0, 4]; the upright one stands on it at x in [0, 4] up to z = 30; the hole of radius 6
    goes along z around (24, 15).
    """
    length, width, height, thick = 40.0, 30.0, 30.0, 4.0
    angle = 2.0 * np.pi * np.arange(hole_corners) / hole_corners
    hole = np.stack([24.0 + 6.0 * np.cos(angle), 15.0 + 6.0 * np.sin(angle)], axis=1)
    builder = _Builder()
    # The underside, and the step beside the upright plate: rectangles with the hole in them.
    under = builder.add(np.array([[0, 0], [length, 0], [length, width], [0, width]]), 0.0)
    step = builder.add(np.array([[thick, 0], [length, 0], [length, width], [thick, width]]), thick)
    hole_under, hole_step = builder.add(hole, 0.0), builder.add(hole, thick)
    builder.annulus(under, hole_under, upward=False)
    builder.annulus(step, hole_step, upward=True)
    for k in range(hole_corners):
        following = (k + 1) % hole_corners
        builder.quad(hole_under[k], hole_step[k], hole_step[following], hole_under[following])
    top = builder.add(np.array([[0, 0], [thick, 0], [thick, width], [0, width]]), height)
    builder.quad(*top)
    builder.quad(step[0], step[3], top[2], top[1])  # the inner face of the upright plate
    builder.quad(under[0], top[0], top[3], under[3])  # its back
    builder.quad(under[1], under[2], step[2], step[1])  # the front end
    # The sides are L-shaped: two quads each, whose common edge runs from the outer to the inner corner of the L.
    builder.quad(under[0], under[1], step[1], step[0])
    builder.quad(under[0], step[0], top[1], top[0])
    builder.quad(under[3], step[3], step[2], under[2])
    builder.quad(under[3], top[3], top[2], step[3])
    return gk.mesh.TriangleMesh(np.array(builder.vertices), np.array(builder.faces), name="bracket")


class _Builder:
    def __init__(self) -> None:
        self.vertices: list[list[float]] = []
        self.faces: list[list[int]] = []

    def add(self, outline: NDArray[np.float64], z: float) -> list[int]:
        first = len(self.vertices)
        self.vertices += [[float(x), float(y), z] for x, y in outline]
        return list(range(first, len(self.vertices)))

    def quad(self, a: int, b: int, c: int, d: int) -> None:
        self.faces += [[a, b, c], [a, c, d]]

    def annulus(self, outer: list[int], inner: list[int], *, upward: bool) -> None:
        """Between a rectangle (from its lower left corner) and a ring within (from angle 0), counter-clockwise both."""
        quarter = len(inner) // 4
        for side in range(4):
            # Each corner sees the quarter of the ring that faces it; one triangle leads on to the next corner.
            corner, following = outer[(side + 2) % 4], outer[(side + 3) % 4]
            last = inner[(side + 1) * quarter % len(inner)]
            fan = [inner[k % len(inner)] for k in range(side * quarter, (side + 1) * quarter + 1)]
            faces = [[b, a, corner] for a, b in itertools.pairwise(fan)] + [[last, corner, following]]
            self.faces += faces if upward else [face[::-1] for face in faces]


def shell(rings: int = 40, around: int = 96) -> gk.mesh.TriangleMesh:
    """Open: the half of a sphere of radius 1 with z >= 0, wavy by 3%, without its rim closed."""
    tilt, turn = np.meshgrid(
        np.linspace(0.0, 0.5 * np.pi, rings + 1)[1:], 2 * np.pi * np.arange(around) / around, indexing="ij"
    )
    radius = 1.0 + 0.03 * np.cos(6.0 * turn) * np.sin(tilt) ** 2
    ring = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], (radius[..., None] * ring).reshape(-1, 3)])
    k = np.arange(around)
    following = (k + 1) % around
    faces = [np.stack([np.zeros_like(k), 1 + k, 1 + following], axis=1)]
    for row in range(rings - 1):
        upper, lower = 1 + row * around, 1 + (row + 1) * around
        faces.append(np.stack([upper + k, lower + k, lower + following], axis=1))
        faces.append(np.stack([upper + k, lower + following, upper + following], axis=1))
    return gk.mesh.TriangleMesh(vertices, np.concatenate(faces), name="shell")


def broken() -> gk.mesh.TriangleMesh:
    """A coarse torus with 20 flipped, 15 duplicated, 10 missing and 12 collapsed faces, 8 slivers, 5 loose vertices."""
    random = np.random.default_rng(SEED)
    whole = torus(48, 24)
    vertices, faces = whole.vertices, whole.faces.copy()
    picked = random.permutation(len(faces))
    faces[picked[:20]] = faces[picked[:20], ::-1]
    duplicates = faces[picked[20:35]]
    # A collapsed face lies on an edge of the mesh; a sliver joins three nearly collinear points next to it.
    collapsed = faces[picked[35:47]][:, [0, 1, 1]]
    base = vertices[faces[picked[47:55]]]
    share = random.uniform(0.3, 0.7, (8, 1))
    tips = base[:, 0] * (1.0 - share) + base[:, 1] * share + 1e-7 * (base[:, 2] - base[:, 0])
    slivers = np.column_stack([faces[picked[47:55], :2], len(vertices) + np.arange(8)])
    loose = random.uniform(-1.0, 1.0, (5, 3))
    kept = np.delete(faces, picked[55:65], axis=0)
    return gk.mesh.TriangleMesh(
        np.concatenate([vertices, tips, loose]),
        np.concatenate([kept, duplicates, collapsed, slivers]),
        name="broken",
    )


def cloud(count: int = 20_000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) spread evenly over the torus, moved along the normals by a noise of 0.002, and normals (N, 3)."""
    random = np.random.default_rng(SEED)
    # The area of a piece of the torus grows with its distance from the axis: drawn by rejection.
    b = random.uniform(0.0, 2.0 * np.pi, 3 * count)
    keep = random.uniform(0.0, TORUS_MAJOR + TORUS_MINOR, 3 * count) < TORUS_MAJOR + TORUS_MINOR * np.cos(b)
    b = b[keep][:count]
    a = random.uniform(0.0, 2.0 * np.pi, count)
    normals = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=1)
    center = np.stack([np.cos(a), np.sin(a), np.zeros(count)], axis=1) * TORUS_MAJOR
    points = center + (TORUS_MINOR + random.normal(0.0, 0.002, (count, 1))) * normals
    return points, normals


def write_cloud(path: Path, points: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
    path.write_bytes(header.encode() + np.hstack([points, normals]).astype("<f4").tobytes())


def write_meshes() -> None:
    gk.mesh.save(FOLDER / "torus.ply", torus())
    gk.mesh.save(FOLDER / "bracket.obj", bracket())
    gk.mesh.save(FOLDER / "shell.stl", shell())
    gk.mesh.save(FOLDER / "broken.obj", broken())
    write_cloud(FOLDER / "cloud.ply", *cloud())


def smoke(size: int = 64, voxel_size: float = SMOKE_VOXEL) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Density (X, Y, Z) of a swirling plume, and its velocity (X, Y, Z, 3); both are zero outside of the plume."""
    random = np.random.default_rng(SEED)
    center = (size // 2, size // 2)
    x, y, z = (np.arange(length, dtype=np.float64) for length in (size, size, size + size // 2))
    x, y, z = np.meshgrid((x - center[0]) * voxel_size, (y - center[1]) * voxel_size, z * voxel_size, indexing="ij")
    # The plume widens and winds around the z axis as it rises.
    drift = 0.15 * z
    dx, dy = x - drift * np.cos(2.0 * z), y - drift * np.sin(2.0 * z)
    density = np.exp(-(dx * dx + dy * dy) / (0.12 + 0.11 * z) ** 2) * np.exp(-0.25 * z)
    for _ in range(6):
        wave, phase = random.normal(0.0, 4.0, 3), random.uniform(0.0, 2.0 * np.pi)
        density *= 1.0 + 0.25 * np.sin(wave[0] * x + wave[1] * y + wave[2] * z + phase)
    density[density < 0.02] = 0.0
    # Rigid rotation around the axis plus a rise that fades outwards.
    velocity = np.stack([-1.5 * y, 1.5 * x, 2.0 * np.exp(-(x * x + y * y))], axis=-1)
    velocity[density == 0.0] = 0.0
    return density.astype(np.float32), velocity.astype(np.float32)


def sparse_volume(values: NDArray[np.float32], name: str, grid_class: str, voxel_size: float) -> gk.volume.SparseVolume:
    """A dense array (X, Y, Z) or (X, Y, Z, 3) as a grid whose active voxels are those that are not zero.

    The first voxel stands at (-X / 2, -Y / 2, 0) voxels.
    """
    import warp as wp

    from geokit.volume.nanovdb.header import (
        MAGIC_OLD,
        TREE_OFFSET,
        aligned_buffer,
        grid_class_code,
        grid_header,
        info_of,
        tree_header,
    )

    vector = values.ndim == 4
    # Blocks of 8^3 voxels, z fastest, as NanoVDB's leaves hold them.
    counts = [length // 8 for length in values.shape[:3]]
    blocks = values.reshape(counts[0], 8, counts[1], 8, counts[2], 8, -1).transpose(0, 2, 4, 1, 3, 5, 6)
    blocks = blocks.reshape(*counts, 512, -1)
    active = np.any(blocks != 0.0, axis=-1)
    tiles = np.argwhere(active.any(axis=-1)).astype(np.int32)
    made = wp.Volume.allocate_by_tiles(
        wp.array(tiles * 8, dtype=wp.int32, device="cpu"),
        voxel_size,
        bg_value=(0.0, 0.0, 0.0) if vector else 0.0,
        translation=(-0.5 * voxel_size * values.shape[0], -0.5 * voxel_size * values.shape[1], 0.0),
        device="cpu",
    )
    content = made.array().numpy()
    buffer = aligned_buffer(len(content))
    buffer[:] = content
    # A leaf: its first voxel, at 16 the mask of active voxels, then (aligned) its values; warp left those at zero.
    begin, size = (
        TREE_OFFSET + int(tree_header(buffer)["node_offset"][0]),
        (128 + 512 * 12) if vector else (96 + 512 * 4),
    )
    for leaf in np.ndarray((len(tiles), size), np.uint8, buffer, begin):
        x, y, z = leaf[:12].view("<i4") // 8
        leaf[16:80] = np.packbits(active[x, y, z], bitorder="little")
        leaf[size - blocks[x, y, z].nbytes :] = blocks[x, y, z].ravel().view(np.uint8)
    tree_header(buffer)["voxel_count"] = np.count_nonzero(active)
    header = grid_header(buffer)
    # warp 1.19 marks its grids as NanoVDB 32.8; OpenVDB 10 reads the same layout under the mark and version of 32.4.
    header["magic"], header["version"], header["checksum"] = MAGIC_OLD, 32 << 21 | 4 << 10, 0xFFFFFFFFFFFFFFFF
    header["name"], header["grid_class"] = name.encode(), grid_class_code(grid_class)
    metadata = {"creator": "geokit data/samples/generate.py"}
    return gk.volume.SparseVolume(buffer, info_of(buffer, metadata, name=name))


def write_volumes() -> None:
    level_set = gk.volume.from_mesh(torus(), 0.04, name="torus", device="cpu")
    gk.volume.save(FOLDER / "torus.vdb", level_set)
    density, velocity = smoke()
    grids = [
        sparse_volume(density, "density", "fog volume", SMOKE_VOXEL),
        sparse_volume(velocity, "velocity", "unknown", SMOKE_VOXEL),
    ]
    gk.volume.save(FOLDER / "smoke.vdb", *grids, half=True)


def main() -> None:
    write_meshes()
    if sys.argv[1:] != ["meshes"]:
        write_volumes()
    files = sorted(path for path in FOLDER.iterdir() if path.suffix not in (".py", ".md"))
    for path in files:
        print(f"{path.stat().st_size:>9,} bytes  {path.name}")


if __name__ == "__main__":
    main()
