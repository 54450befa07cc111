"""Nearest neighbors on a GPU: comparison with the CPU's answers, and times beside a tiled brute force in raw warp.

Where jztree and jax are installed (``pip install jztree[cuda13] jax[cuda13]``), beside jztree's k nearest too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.gpu_timing import wall_median
from geokit.points.search.nearest import nearest
from geokit.points.search.nearest_tree import build_tree

COMPARED, POINTS = 20_000, 1 << 20
LENGTHS = (1, 8, 16, 32, 100, 1024)
# Length of the brute force's list, equal to the k of the comparison.
K = 16
TILE = wp.constant(256)
THREADS = 128
RUNS = 5
# Points and lengths of the comparison with jztree.
PEER_POINTS, PEER_LENGTHS = (1 << 20, 1 << 23), (1, 8, 16, 32, 64, 100, 128)
# Numbers of the largest result that is asked for.
MOST_NUMBERS = 1 << 30
# Queries of a block of torch: their distances to a million points take 8 GiB.
BLOCK = 2048

distances16 = wp.types.vector(length=16, dtype=wp.float32)
indices16 = wp.types.vector(length=16, dtype=wp.int32)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def brute_kernel(
    points: wp.array(dtype=wp.vec3f),
    threads: int,
    out_distance: wp.array2d(dtype=wp.float32),
    out_indices: wp.array2d(dtype=wp.int32),
):
    """All points against all, a tile of them in shared memory at a time; float32, a list of 16 in registers."""
    block, lane = wp.tid()
    i = block * threads + lane
    p = points[i]
    best = distances16(wp.inf)
    found = indices16(-1)
    for start in range(0, points.shape[0], TILE):
        tile = wp.tile_load(points, shape=TILE, offset=start, storage="shared")
        for j in range(TILE):
            d = wp.length_sq(tile[j] - p)
            if d < best[15]:
                best[15] = d
                found[15] = start + j
                for s in range(15):
                    if best[15 - s] < best[14 - s]:
                        t = best[14 - s]
                        best[14 - s] = best[15 - s]
                        best[15 - s] = t
                        n = found[14 - s]
                        found[14 - s] = found[15 - s]
                        found[15 - s] = n
    for s in range(16):
        out_distance[i, s] = wp.sqrt(best[s])
        out_indices[i, s] = found[s]


def brute_force(points: wp.array) -> tuple[wp.array, wp.array]:
    """Distances and indices of the 16 nearest of vec3f points, whose number TILE and THREADS divide."""
    device = points.device
    threads = THREADS if device.is_cuda else 1
    distance = wp.empty((len(points), 16), dtype=wp.float32, device=device)
    indices = wp.empty((len(points), 16), dtype=wp.int32, device=device)
    wp.launch_tiled(
        brute_kernel,
        dim=[len(points) // threads],
        inputs=[points, threads],
        outputs=[distance, indices],
        block_dim=threads,
        device=device,
    )
    return distance, indices


def torch_brute_force(points: wp.array) -> Callable[[], Any] | None:
    """The same in torch by blocks, if torch is installed: distances (N, 16)."""
    try:
        import torch
    except ImportError:
        return None
    every = wp.to_torch(points)

    def run() -> Any:
        parts = [
            torch.cdist(every[at : at + BLOCK], every).topk(K, largest=False)[0] for at in range(0, len(every), BLOCK)
        ]
        return torch.cat(parts)

    return run


def clouds(count: int) -> dict[str, np.ndarray]:
    """Points by kind: uniform, and crowds unsuited to a grid of equal cells."""
    random = np.random.default_rng(0)
    uniform = random.random((count, 3))
    cluster = uniform.copy()
    cluster[: count // 2] = 0.4 + cluster[: count // 2] * 0.01 ** (1 / 3)
    outlier = uniform.copy()
    outlier[0] = 1e9
    axis = np.arange(round(count ** (1 / 3)))
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3).astype(np.float64)
    return {
        "uniform": uniform,
        "half in 1%": cluster,
        "plane": uniform * [1, 1, 0],
        "line": uniform * [1, 0, 0],
        "far point": outlier,
        "lattice": lattice,
        "duplicates": uniform[random.integers(0, count // 50, count)],
        "heavy tails": random.standard_cauchy((count, 3)),
    }


def answers(points: np.ndarray, k: int, queries: np.ndarray | None, device: str, **options: Any) -> list[np.ndarray]:
    tree = build_tree(wp.array(points, dtype=wp.vec3d, device=device))
    rows = None if queries is None else wp.array(queries, dtype=wp.vec3d, device=device)
    return [out.numpy() for out in nearest(tree, k, rows, **options)]


def check_bits(out: Callable[[str], None], device: str) -> None:
    """Number of rows in which CPU and GPU differ, which must be 0."""
    lengths = ", ".join(map(str, LENGTHS))
    out(f"Their own points, self excluded, and others within a limit; k = {lengths}.\n")
    out("| points | rows | rows that differ |")
    out("|---|---:|---:|")
    queries = np.random.default_rng(1).random((COMPARED // 4, 3)) * 3.0 - 1.0
    cases: list[tuple[np.ndarray | None, dict[str, Any]]] = [
        (None, {}),
        (None, {"exclude_self": True}),
        (queries, {"limit_squared": 0.05}),
    ]
    for kind, points in clouds(COMPARED).items():
        rows, wrong = 0, 0
        for k in LENGTHS:
            for asked, options in cases:
                pair = [answers(points, k, asked, where, **options) for where in ("cpu", device)]
                differ = np.zeros(len(pair[0][0]), dtype=bool)
                for a, b in zip(*pair, strict=True):
                    differ |= (a != b).any(axis=1)
                rows, wrong = rows + len(differ), wrong + int(differ.sum())
        out(f"| {kind} | {rows:,} | {wrong} |")


def check_times(out: Callable[[str], None], device: str, count: int = POINTS) -> None:
    """Times at k = 16 against the brute force, after comparing the answers; then other k and crowds."""
    points = clouds(count)["uniform"]
    rows = wp.array(points, dtype=wp.vec3d, device=device)
    single = wp.array(points.astype(np.float32), dtype=wp.vec3f, device=device)
    distance, _ = nearest(build_tree(rows), K, None)
    raw, _ = brute_force(single)
    out(f"largest difference of the distances: {np.abs(distance.numpy() - raw.numpy()).max():.1e}")
    out("")
    peers = {"tiles in raw warp": wall_median(partial(brute_force, single), 1, warm=0)}
    blocks = torch_brute_force(single)
    if blocks is not None:
        apart = np.abs(distance.numpy() - blocks().cpu().numpy()).max()
        out(f"torch's, by matrix products in float32: {apart:.1e}\n")
        peers["torch.cdist and topk in blocks"] = wall_median(blocks, 1, warm=0)
    out("| points | k | build (ms) | search (ms) | queries (M/s) |")
    out("|---|---:|---:|---:|---:|")
    for kind, values in clouds(count).items():
        rows = wp.array(values, dtype=wp.vec3d, device=device)
        build = wall_median(partial(build_tree, rows), RUNS)
        tree = build_tree(rows)
        for k in LENGTHS[:-1] if kind == "uniform" else (K,):
            search = wall_median(partial(nearest, tree, k, None), RUNS)
            if kind == "uniform" and k == K:
                ours = build + search
            out(f"| {kind} | {k} | {build * 1e3:.1f} | {search * 1e3:.1f} | {len(values) / search / 1e6:.1f} |")
    out("\n| all pairs, k = 16, uniform | ms | G distances/s | geokit's time, build included, is shorter by |")
    out("|---|---:|---:|---:|")
    for name, brute in peers.items():
        out(f"| {name} | {brute * 1e3:.0f} | {float(count) ** 2 / brute / 1e9:.0f} | {brute / ours:.0f} times |")


def jztree_search(points: np.ndarray, k: int) -> Callable[[], Any] | None:
    """The k nearest points by jztree in float32, its tree included, if it is installed: distances and indices."""
    try:
        import jax
        from jztree.knn import knn
    except ImportError:
        return None
    rows, search = jax.numpy.asarray(points, dtype=jax.numpy.float32), jax.jit(partial(knn, k=k))
    return lambda: jax.block_until_ready(search(rows))


def check_jztree(out: Callable[[str], None], device: str) -> None:
    """Times with the trees included beside jztree's, after comparing the distances."""
    if jztree_search(np.zeros((64, 3)), 1) is None:
        out("jztree is not installed")
        return
    out("| points | k | geokit (ms) | jztree, float32 (ms) | times as fast | largest difference of distances |")
    out("|---|---:|---:|---:|---:|---:|")
    for count in PEER_POINTS:
        for kind in ("uniform", "half in 1%"):
            points = clouds(count)[kind]
            rows = wp.array(points, dtype=wp.vec3d, device=device)
            for k in PEER_LENGTHS:
                peer = jztree_search(points, k) if count * k <= MOST_NUMBERS else None
                if peer is None:
                    continue
                # Where points are at the same place in float32, neither list is wrong.
                apart = np.abs(nearest(build_tree(rows), k, None)[0].numpy() - np.asarray(peer()[0])).max()
                ours = wall_median(lambda rows=rows, k=k: nearest(build_tree(rows), k, None), RUNS)
                theirs = wall_median(peer, RUNS)
                out(
                    f"| {count:,} {kind} | {k} | {ours * 1e3:.1f} | {theirs * 1e3:.1f} | {theirs / ours:.2f} | "
                    f"{apart:.1e} |"
                )


def main(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Print the tables."""
    check_bits(out, device)
    out("")
    check_times(out, device)
    out("")
    check_jztree(out, device)


if __name__ == "__main__":
    main(print)
