"""Orders 0 to 3, Hessians, curvatures and active states on a GPU: agreement with the CPU, and times."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.sphere_volumes import sphere_leaves
from benchmarks.catalog.typed_grids import VALUED, TypedGrid
from benchmarks.gpu_timing import device_median
from geokit.core import launcher
from geokit.volume._curvature import curvature, hessian
from geokit.volume.at_points.active import active_at
from geokit.volume.at_points.sample import gradient, sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import aligned_buffer, info_of
from geokit.volume.retyped.from_channel import from_channel

POINTS = 10_000_000
CHECKED = 200_000
RUNS = 7
RADIUS = 200.0


@wp.kernel
def raw_linear_kernel(first: int, volume: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    u = wp.volume_world_to_index(volume, points[i])
    out[i] = wp.volume_sample_f(volume, u, wp.Volume.LINEAR)


def level_set() -> SparseVolume:
    """A sphere's band of 6 voxels on either side, wide enough for the stencils of order 3 around the surface."""
    origins, values, masks = sphere_leaves(RADIUS, half_width=6.0)
    buffer = build_float_grid(
        origins,
        values,
        masks,
        background=6.0,
        transform=np.eye(4),
        name="sphere",
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


def near_surface(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (RADIUS + rng.uniform(-2.0, 2.0, (count, 1)))


def median(run: Callable[[], Any]) -> float:
    return device_median(run, RUNS)


def difference(a: Any, b: Any) -> float:
    """Largest difference, in units of the largest finite number; non-finite values must be identical."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    finite = np.isfinite(a)
    assert np.array_equal(finite, np.isfinite(b))
    return float(np.abs(a[finite] - b[finite]).max(initial=0.0) / max(np.abs(a[finite]).max(initial=0.0), 1e-300))


def check_types(out: Callable[[str], None], device: str) -> None:
    """Every value type, every order: the largest relative difference of the CPU's and the GPU's answers."""
    u = np.random.default_rng(1).uniform([-11, -3, -3], [11, 11, 19], (5000, 3))
    out("| type | value, orders 0 to 3 | gradient, orders 0 to 3 | Hessian, orders 2, 3 | active states that differ |")
    out("|---|---|---|---|---:|")
    grids = [(kind, TypedGrid(kind).volume) for kind in VALUED]
    source = TypedGrid("vec3f").volume
    buffer = aligned_buffer(len(source.nanovdb))
    buffer[:] = source.nanovdb
    grids.append(("vec3f, staggered", SparseVolume(buffer, dataclasses.replace(source.info, grid_class="staggered"))))
    for kind in ("index", "onindex"):
        grids.append((kind, IndexGrid(kind, [("values", "float")]).volume))
    for name, volume in grids:
        columns = []
        for function in (sample, gradient):
            found = [
                difference(*(function(volume, u, order=order, device=d) for d in ("cpu", device))) for order in range(4)
            ]
            columns.append(", ".join(f"{value:.0e}" for value in found))
        valued = from_channel(volume) if "index" in name else volume
        second = ""
        if not isinstance(valued.info.background, tuple):
            found = [difference(*(hessian(valued, u, order=o, device=d) for d in ("cpu", device))) for o in (2, 3)]
            second = ", ".join(f"{value:.0e}" for value in found)
        states = [active_at(volume, u, device=d) for d in ("cpu", device)]
        out(f"| {name} | {columns[0]} | {columns[1]} | {second} | {int((states[0] != states[1]).sum())} |")


def check_times(out: Callable[[str], None], device: str) -> None:
    """A level set in float64: times beside warp's trilinear sample in float32."""
    volume = level_set()
    points = wp.array(near_surface(POINTS), dtype=wp.vec3d, device=device)
    single = wp.array(points.numpy().astype(np.float32), dtype=wp.vec3, device=device)
    raw_out = wp.empty(POINTS, dtype=wp.float32, device=device)
    raw_inputs = [wp.uint64(volume.id(device)), single]
    target = wp.get_device(device)
    raw = median(lambda: launcher.launch(raw_linear_kernel, POINTS, raw_inputs, [raw_out], target))
    few = points.numpy()[:CHECKED]
    out("| what | order | G points / s | time / that of warp's volume_sample_f | CPU and GPU differ |")
    out("|---|---:|---:|---:|---:|")
    calls: list[tuple[str, Any, tuple[int, ...]]] = [
        ("value", sample, (0, 1, 2, 3)),
        ("gradient", gradient, (0, 1, 2, 3)),
        ("Hessian", hessian, (2, 3)),
        ("curvature", lambda *a, **k: curvature(*a, **k).mean, (2, 3)),
    ]
    for name, function, orders in calls:
        for order in orders:
            time = median(lambda f=function, order=order: f(volume, points, order=order, device=device))
            found = difference(*(function(volume, few, order=order, device=d) for d in ("cpu", device)))
            out(f"| {name} | {order} | {POINTS / time / 1e9:.2f} | {time / raw:.1f} | {found:.0e} |")
    time = median(lambda: active_at(volume, points, device=device))
    states = [active_at(volume, few, device=d) for d in ("cpu", device)]
    out(f"| active | | {POINTS / time / 1e9:.2f} | {time / raw:.1f} | {int((states[0] != states[1]).sum())} states |")


def main(out: Callable[[str], None]) -> None:
    device = "cuda:0"
    out(
        f"{wp.get_device(device).name}; {POINTS:,} points in random order near a sphere of {RADIUS:.0f} voxels radius\n"
    )
    check_types(out, device)
    out("")
    check_times(out, device)


if __name__ == "__main__":
    main(print)
