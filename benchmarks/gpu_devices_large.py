"""The largest inputs on several GPUs: ``python -m benchmarks.gpu_devices_large [one] [parts] [--queries N]``.

``one``: a mesh of 98 million triangles on each GPU, asked N rows of host memory on 1, 2, 4, ... GPUs: seconds, memory,
and whether the bits are the same. ``parts``: a mesh that one GPU cannot hold, in strips that are dealt to the GPUs.
Each row is asked the strip that it lies over, then those whose box is nearer than what was found; some rows are asked
all strips, which must not change the answer.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_large import SIDES, WIDTH, terrain
from geokit.core import launcher

BLOCK = 1 << 20
LOWEST, HIGHEST = -1.5, 1.5
STRIPS = 8
CELLS = 5657  # along each side of a strip: 64 million triangles
PART_QUERIES = 20_000_000


def blocks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK))


def random_rows(count: int, length: float = WIDTH) -> np.ndarray:
    """Points over all of the terrain, which is so long, made by all cores; the same on each machine."""
    rows = np.empty((count, 3))

    def fill(numbered: tuple[int, slice]) -> None:
        number, block = numbered
        rows[block] = np.random.default_rng(number).uniform([0, 0, LOWEST], [length, WIDTH, HIGHEST], rows[block].shape)

    with ThreadPoolExecutor() as pool:
        list(pool.map(fill, enumerate(blocks(count))))
    return rows


def sums(answer: Any) -> list[np.ndarray]:
    """For each field the sums of the bits of a million rows each, weighted by their places."""

    def of(field: np.ndarray, block: slice) -> int:
        bits = np.ascontiguousarray(field[block]).view(np.uint32 if field.itemsize == 4 else np.uint64).ravel()
        return int((bits.astype(np.uint64) * np.arange(1, len(bits) + 1, dtype=np.uint64)).sum())

    with ThreadPoolExecutor() as pool:
        return [np.array(list(pool.map(lambda b, f=field: of(f, b), blocks(len(field))))) for field in answer]


def used(gpu: str) -> float:
    device = wp.get_device(gpu)
    return (device.total_memory - device.free_memory) / 2**30


def one_mesh(queries: int) -> None:
    gpus = launcher.cuda_devices()
    start = time.perf_counter()
    mesh, rows = gk.mesh.TriangleMesh(*terrain(SIDES["98 M"])), random_rows(queries)
    print(
        f"{mesh.face_count:,} triangles, {queries:,} points made in {time.perf_counter() - start:.0f} s\n", flush=True
    )
    print(
        "| GPUs | prepared [s] | GiB on each | closest points [s] | million a second | bits |\n"
        "|---|---|---|---|---|---|"
    )
    expected: list[np.ndarray] | None = None
    for count in [n for n in (1, 2, 4, 8) if n <= len(gpus)]:
        before = used(gpus[0])
        start = time.perf_counter()
        surface = gk.mesh.Surface(mesh, device=gpus[:count])
        surface.closest_point(rows[:BLOCK])
        wp.synchronize()
        prepared, memory = time.perf_counter() - start, used(gpus[0]) - before
        start = time.perf_counter()
        answer = surface.closest_point(rows)
        seconds = time.perf_counter() - start
        found = sums(answer)
        del answer, surface
        same = expected is None or all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
        expected = expected or found
        print(
            f"| {count} | {prepared:.1f} | {memory:.1f} | {seconds:.1f} | {queries / seconds / 1e6:.1f} | "
            f"{'the same' if same else 'DIFFERENT'} |",
            flush=True,
        )


class Found(NamedTuple):
    """The nearest triangles of all strips."""

    distance: np.ndarray
    points: np.ndarray
    triangle_id: np.ndarray


class MeshInParts:
    """Closest points of a mesh that is cut into strips along x, which are dealt to the GPUs.

    Args:
        meshes: The strips, in the order of their faces.
        gpus: Strip k is on GPU k modulo their number.
    """

    def __init__(self, meshes: Iterator[gk.mesh.TriangleMesh], gpus: Sequence[str]) -> None:
        self._gpus = gpus
        self._strips, self._boxes, self._first = [], [], [0]
        for number, mesh in enumerate(meshes):
            self._strips.append(gk.mesh.Surface(mesh, device=gpus[number % len(gpus)]))
            print(f"strip {number}: " + ", ".join(f"{used(gpu):.1f}" for gpu in gpus) + " GiB", flush=True)
            self._boxes.append(mesh.bounds)
            self._first.append(self._first[-1] + mesh.face_count)

    def closest_point(self, rows: np.ndarray) -> tuple[Found, int]:
        """Also how many questions the rows were: one for each strip that had to be asked."""
        reach = np.stack([self._distance_to_box(rows, box) for box in self._boxes])
        best = Found(np.full(len(rows), np.inf), np.full((len(rows), 3), np.nan), np.full(len(rows), -1, np.int64))
        nearest = reach.argmin(axis=0)
        asked = 0
        # The strip that a row lies over, or is nearest to; then all that could have a nearer triangle.
        for wanted in (lambda k: nearest == k, lambda k: (nearest != k) & (reach[k] <= best.distance)):
            chosen = [np.flatnonzero(wanted(k)) for k in range(len(self._strips))]
            asked += sum(map(len, chosen))
            with ThreadPoolExecutor(len(self._gpus)) as pool:  # a GPU's strips in turn
                answers = list(pool.map(functools.partial(self._of_gpu, rows, chosen), range(len(self._gpus))))
            for number, found in sorted((pair for answer in answers for pair in answer), key=lambda pair: pair[0]):
                own = chosen[number]
                # Of equally near triangles the lowest number wins: strips come in the order of their faces.
                wins = (found.distance < best.distance[own]) | (
                    (found.distance == best.distance[own]) & (self._first[number] < best.triangle_id[own])
                )
                best.distance[own[wins]] = found.distance[wins]
                best.points[own[wins]] = found.points[wins]
                best.triangle_id[own[wins]] = found.triangle_id[wins] + self._first[number]
        return best, asked

    def _of_gpu(self, rows: np.ndarray, chosen: list[np.ndarray], gpu: int) -> list[tuple[int, Any]]:
        own = range(gpu, len(self._strips), len(self._gpus))
        return [(k, self._strips[k].closest_point(rows[chosen[k]])) for k in own if len(chosen[k])]

    @staticmethod
    def _distance_to_box(rows: np.ndarray, box: np.ndarray) -> np.ndarray:
        outside = np.maximum(np.maximum(box[0] - rows, rows - box[1]), 0.0)
        # Rounded down: a strip that could have a nearer triangle is never left out.
        return np.sqrt(np.einsum("ij,ij->i", outside, outside)) * (1.0 - 1e-12)


def strip(number: int, flat: tuple[np.ndarray, np.ndarray]) -> gk.mesh.TriangleMesh:
    """The terrain again, moved along x; odd ones are mirrored, so that neighbors share their border."""
    vertices = flat[0].copy()
    if number % 2:
        vertices[:, 0] = WIDTH - vertices[:, 0]
    vertices[:, 0] += number * WIDTH
    return gk.mesh.TriangleMesh(vertices, flat[1])


def parts(count: int) -> None:
    gpus = launcher.cuda_devices()
    flat = terrain(CELLS)
    start = time.perf_counter()
    whole = MeshInParts((strip(number, flat) for number in range(count)), gpus)
    seconds = time.perf_counter() - start
    memory = ", ".join(f"{used(gpu):.0f}" for gpu in gpus)
    print(f"\n{count} strips, {len(flat[1]) * count:,} triangles on {len(gpus)} GPUs: {seconds:.0f} s, {memory} GiB\n")
    rows = random_rows(PART_QUERIES, WIDTH * count)
    whole.closest_point(rows[:BLOCK])
    start = time.perf_counter()
    found, asked = whole.closest_point(rows)
    seconds = time.perf_counter() - start
    print(f"{len(rows):,} closest points: {seconds:.1f} s, {asked / len(rows):.4f} strips a row", flush=True)
    # Strips asked one by one, all of them: what the choice by boxes must not change.
    some = rows[:: len(rows) // 200_000]
    alone = np.stack([one.closest_point(some).distance for one in whole._strips])
    same = np.array_equal(alone.min(axis=0), found.distance[:: len(rows) // 200_000])
    number = found.triangle_id[:: len(rows) // 200_000] // len(flat[1])
    print(f"all strips asked by {len(some):,} rows: distances {'the same' if same else 'DIFFERENT'}, ", end="")
    print(f"strips {'the same' if np.array_equal(alone.argmin(axis=0), number) else 'DIFFERENT'}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=("one", "parts"), default=["one", "parts"])
    parser.add_argument("--queries", type=int, default=1_000_000_000)
    parser.add_argument("--strips", type=int, default=STRIPS)
    arguments = parser.parse_args()
    print(f"{len(launcher.cuda_devices())} x {wp.get_device('cuda:0').name}\n")
    if "one" in arguments.what:
        one_mesh(arguments.queries)
    if "parts" in arguments.what:
        parts(arguments.strips)
