"""Narrow bands on a GPU beside the CPU and beside raw warp queries; part of benchmarks.gpu_volumes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from benchmarks.gpu_timing import wall_median
from geokit.core import launcher
from geokit.volume.band.tiles import Lattice, near_tiles
from geokit.volume.distance_fields.from_mesh import from_mesh_with_triangles

TRIANGLES = 195_200
RESOLUTIONS = (256, 512, 1024, 2048)
COMPARED = (128, 256)
RUNS = 5


@wp.kernel
def raw_band_kernel(
    first: int,
    mesh: wp.uint64,
    tiles: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    origin: wp.vec3,
    scale: float,
    reach: float,
    out_distance: wp.array(dtype=float),
):
    """Baseline as a warp user would write it: a signed query for each voxel of the same tiles."""
    i = first + wp.tid()
    tile = tiles[i >> 9]
    voxel = i & 511
    index = wp.vec3(
        float(8 * tile[0] + (voxel >> 6)), float(8 * tile[1] + ((voxel >> 3) & 7)), float(8 * tile[2] + (voxel & 7))
    )
    p = (index * voxel_size - origin) / scale
    found = wp.mesh_query_point_sign_normal(mesh, p, reach / scale)
    out_distance[i] = reach
    if found.result:
        closest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        out_distance[i] = found.sign * wp.length(p - closest) * scale


def surface_and_voxel(resolution: int, device: str) -> tuple[Any, float]:
    mesh = inputs.bunny_of(TRIANGLES)
    surface = gk.mesh.Surface(mesh, device=device)
    surface.sign_method  # noqa: B018 - the proof is prepared, as for any other query
    return surface, float((mesh.bounds[1] - mesh.bounds[0]).max()) / resolution


def median(run: Callable[[], Any]) -> float:
    return wall_median(run, RUNS)


@contextmanager
def kernel_times(device: wp.Device) -> Iterator[dict[str, float]]:
    """Seconds of each kernel within the context, with the device synchronized after each."""
    spent: dict[str, float] = {}
    plain = launcher.launch

    def timed(kernel: Any, *arguments: Any, **options: Any) -> None:
        wp.synchronize_device(device)
        start = time.perf_counter()
        plain(kernel, *arguments, **options)
        wp.synchronize_device(device)
        spent[kernel.key] = spent.get(kernel.key, 0.0) + time.perf_counter() - start

    launcher.launch = timed
    try:
        yield spent
    finally:
        launcher.launch = plain


def check_band(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Compares CPU and GPU: the same leaves, values within rounding, the same signs, the same nearest triangles."""
    out("| band | leaves and masks | largest difference [voxels] | other signs | other triangles | samples [voxels] |")
    out("|---|---|---:|---:|---:|---:|")
    cases: list[tuple[str, dict[str, Any]]] = [
        ("level set", {}),
        ("4 outside, 2 inside", {"half_width": (4.0, 2.0)}),
        ("winding", {"sign": "winding"}),
        ("unsigned", {"sign": "none"}),
        ("shell", {"thickness": 0.05}),
    ]
    for resolution in COMPARED:
        for name, options in cases:
            made = []
            for where in ("cpu", device):
                surface, voxel = surface_and_voxel(resolution, where)
                made.append(from_mesh_with_triangles(surface, voxel, **options))
            # Sampled before any download: data that stays on the device is used there.
            points = inputs.near(surface.mesh, 10_000)
            sampled = [each.distance.sample(points, device=at) for each, at in zip(made, ("cpu", device), strict=True)]
            sound = float(np.abs(sampled[0] - sampled[1]).max() / voxel)
            a, b = (each.distance.nanovdb for each in made)
            same = len(a) == len(b) and a[672:736].tobytes() == b[672:736].tobytes()
            if not same:
                out(f"| {resolution}^3, {name} | differ | | | | |")
                continue
            leaves = [leaf_rows(each) for each in (a, b)]
            masks = np.array_equal(leaves[0][:, :64], leaves[1][:, :64])
            values = [rows[:, 96:].copy().view(np.float32).astype(np.float64) for rows in leaves]
            apart = float(np.abs(values[0] - values[1]).max() / voxel)
            signs = int((np.signbit(values[0]) != np.signbit(values[1])).sum())
            ids = [leaf_rows(each.triangle_id.nanovdb)[:, 96:].copy().view(np.int32) for each in made]
            others = int((ids[0] != ids[1]).sum())
            out(
                f"| {resolution}^3, {name} | {'equal' if masks else 'masks differ'} | {apart:.1e} | {signs} | {others} "
                f"| {sound:.1e} |"
            )


def leaf_rows(buffer: np.ndarray) -> np.ndarray:
    """Bytes of the leaves, 2144 each."""
    begin = 672 + int(buffer[672:680].view("<u8")[0])
    count = int(buffer[704:708].view("<u4")[0])
    return buffer[begin : begin + 2144 * count].reshape(count, 2144)


def check_times(out: Callable[[str], None], device: str = "cuda:0") -> None:
    """Times of whole bands that stay on the device, of their download, and of raw queries of the same voxels."""
    out("| voxels | active | band [ms] | M active/s | with download [ms] | raw queries [ms] | largest kernels |")
    out("|---|---:|---:|---:|---:|---:|---|")
    for resolution in RESOLUTIONS:
        surface, voxel = surface_and_voxel(resolution, device)
        target = surface._device
        volume = gk.volume.from_mesh(surface, voxel)
        active = volume.info.active_voxel_count or 0
        whole = median(partial(gk.volume.from_mesh, surface, voxel))
        fetched = median(partial(fetched_band, surface, voxel))
        with kernel_times(target) as spent:
            gk.volume.from_mesh(surface, voxel)
        total = sum(spent.values())
        largest = ", ".join(
            f"{name.removesuffix('_kernel')} {1e3 * seconds:.2f}"
            for name, seconds in sorted(spent.items(), key=lambda item: -item[1])[:6]
        )
        raw = median(raw_queries(surface, voxel))
        out(
            f"| {resolution}^3 | {active:,} | {1e3 * whole:.2f} | {active / whole / 1e6:.0f} | {1e3 * fetched:.2f} | "
            f"{1e3 * raw:.2f} | of {1e3 * total:.2f}: {largest} |"
        )


def fetched_band(surface: Any, voxel: float) -> np.ndarray:
    return gk.volume.from_mesh(surface, voxel).nanovdb


def raw_queries(surface: Any, voxel: float) -> Callable[[], None]:
    target = surface._device
    reach = 3.0 * voxel
    tiles = near_tiles(Lattice(surface, voxel, reach)).coordinates
    step = (1 << 28) // 512
    room = wp.empty(512 * min(step, len(tiles)), dtype=wp.float32, device=target)
    where = [float(voxel), wp.vec3(*map(float, surface.origin)), float(surface.scale), float(reach)]

    def run() -> None:
        for start in range(0, len(tiles), step):
            part = tiles[start : min(start + step, len(tiles))]
            launcher.launch(raw_band_kernel, 512 * len(part), [wp.uint64(surface.id), part, *where], [room], target)

    return run


def main(out: Callable[[str], None] = print, device: str = "cuda:0") -> None:
    check_band(out, device)
    out("")
    check_times(out, device)


if __name__ == "__main__":
    main()
