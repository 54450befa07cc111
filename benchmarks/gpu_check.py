"""Compares a GPU's answers with the CPU's, and its rates with raw warp: ``python -m benchmarks.gpu_check [--out DIR]``.

Absolute times are meaningful only with the name of the GPU, which the table includes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import warp as wp

import geokit as gk
from benchmarks import inputs
from benchmarks.raw_kernels import raw_closest_kernel, raw_count_in_order_kernel, raw_ray_kernel, raw_sample_kernel
from geokit.mesh.sign.choice import choose_sign


class CudaExporter:
    """An object with only the CUDA array protocol, like one of a library unknown to geokit."""

    def __init__(self, array):
        self.array = array
        self.__cuda_array_interface__ = array.__cuda_array_interface__


def median_seconds(call, device, runs=5):
    call()
    times = []
    for _ in range(runs):
        wp.synchronize_device(device)
        start = time.perf_counter()
        call()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def compare(mesh, device, rows):
    """Answers of the two devices; each row names the comparison, the number of answers and the largest difference."""
    cpu, gpu = gk.mesh.Surface(mesh, device="cpu"), gk.mesh.Surface(mesh, device=device)
    diagonal = mesh.diagonal
    points = np.concatenate([inputs.uniform(mesh, 100_000), inputs.near(mesh, 100_000)])
    a, b = cpu.closest_point(points), gpu.closest_point(points)
    rows.append(("closest point: distance / diagonal", len(points), np.abs(a.distance - b.distance).max() / diagonal))
    differ = a.triangle_id != b.triangle_id
    rows.append(("closest point: other triangle", len(points), int(differ.sum())))
    tie = np.abs(a.distance - b.distance)[differ]
    rows.append(
        ("... whose distance differs / diagonal", int(differ.sum()), (tie.max() if len(tie) else 0.0) / diagonal)
    )
    a, b = cpu.winding_number(points), gpu.winding_number(points)
    rows.append(("winding number", len(points), np.abs(a - b).max()))
    rows.append(("contains: other side", len(points), int((cpu.contains(points) != gpu.contains(points)).sum())))
    origins, directions = inputs.random_rays(mesh, 200_000)
    a, b = cpu.raycast(origins, directions), gpu.raycast(origins, directions)
    hit = a.triangle_id >= 0
    rows.append(("first hit: hit or miss differs", len(hit), int((hit != (b.triangle_id >= 0)).sum())))
    both = hit & (b.triangle_id >= 0)
    rows.append(("first hit: t / diagonal", int(both.sum()), np.abs(a.t[both] - b.t[both]).max() / diagonal))
    occluded = gpu.occluded(origins, directions)
    rows.append(("occluded: differs from first hit", len(hit), int((occluded != (b.triangle_id >= 0)).sum())))
    a, b = cpu.crossing_count(origins, directions), gpu.crossing_count(origins, directions)
    rows.append(("crossing counts that differ", len(a), int((a != b).sum())))
    a, b = cpu.raycast_all(origins, directions), gpu.raycast_all(origins, directions)
    rows.append(("all hits: t / diagonal", len(a.t), np.abs(a.t - b.t).max() / diagonal))
    for sign in ("pseudonormal", "parity", "winding"):
        a, b = (s.signed_distance(points, sign=sign).distance for s in (cpu, gpu))
        rows.append((f"signed distance by {sign}: differs", len(points), int((a != b).sum())))
    far = mesh.bounds.mean(axis=0) + np.random.default_rng(4).normal(size=(100_000, 3)) * 1000 * diagonal
    a, b = cpu.closest_point(far), gpu.closest_point(far)
    rows.append(("closest point from 1000 diagonals: differs", len(far), int((a.distance != b.distance).sum())))
    a, b = cpu.raycast(far, points[: len(far)] - far), gpu.raycast(far, points[: len(far)] - far)
    rows.append(("first hit from there: other triangle", len(far), int((a.triangle_id != b.triangle_id).sum())))
    a, b = cpu.furthest_point(points), gpu.furthest_point(points)
    rows.append(("furthest point: differs", len(points), int((a.distance != b.distance).sum())))
    voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 128
    a, b = gk.volume.from_mesh(cpu, voxel), gk.volume.from_mesh(gpu, voxel)
    rows.append(("narrow band 128^3: bytes that differ", len(a.nanovdb), int((a.nanovdb != b.nanovdb).sum())))
    for order in (0, 1):
        difference = np.abs(a.sample(points, order=order, device="cpu") - a.sample(points, order=order, device=device))
        rows.append((f"sample, order {order}: / voxel", len(points), difference.max() / voxel))
    difference = np.abs(a.gradient(points, device="cpu") - a.gradient(points, device=device))
    rows.append(("gradient", len(points), difference.max()))
    cloud = np.random.default_rng(5).random((100_000, 3))
    grids = [gk.points.NeighborGrid(cloud, 0.04, device=d) for d in ("cpu", device)]
    a, b = (grid.radius_search(cloud[:20_000], radius=0.04) for grid in grids)
    same = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    rows.append(("neighbors: lists that differ", len(a.indices), 0 if same else 1))
    counts = [grid.count(cloud) for grid in grids]
    rows.append(("neighbor counts that differ", len(cloud), int((counts[0] != counts[1]).sum())))
    check_overlaps(cpu, gpu, points, rows)
    check_containers(gpu, points[:1000], device, rows)
    check_leaks(gpu, device, rows)


def compare_deep(mesh, device, rows):
    """Trees that end before every triangle has its own leaf: very many triangles, or all in one place."""
    large = inputs.subdivided(mesh, 4)
    heap = gk.mesh.TriangleMesh(
        np.concatenate([mesh.vertices, mesh.vertices[mesh.faces[0]]]),
        np.concatenate([mesh.faces, np.tile(len(mesh.vertices) + np.arange(3), (5000, 1))]),
    )
    for name, one in (("3.1 M triangles", large), ("5,000 triangles in one place", heap)):
        cpu, gpu = gk.mesh.Surface(one, device="cpu"), gk.mesh.Surface(one, device=device)
        points = np.concatenate([inputs.uniform(one, 50_000), inputs.near(one, 50_000)])
        a, b = cpu.closest_point(points), gpu.closest_point(points)
        rows.append((f"{name}: closest triangle differs", len(points), int((a.triangle_id != b.triangle_id).sum())))
        rays = inputs.random_rays(one, 200_000)
        aimed = one.vertices[one.faces[0]].mean(axis=0) - rays[0]
        for what, directions in (("random", rays[1]), ("aimed", aimed)):
            a, b = cpu.raycast(rays[0], directions), gpu.raycast(rays[0], directions)
            rows.append(
                (f"{name}: first hit, {what}: differs", len(aimed), int((a.triangle_id != b.triangle_id).sum()))
            )


def check_overlaps(cpu, gpu, points, rows):
    half = 0.02 * cpu.mesh.diagonal * np.random.default_rng(6).random((len(points), 1)) ** 2
    a, b = (s.overlapping(points - half, points + half) for s in (cpu, gpu))
    same = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    rows.append(("boxes' triangles: lists that differ", len(a.triangle_id), 0 if same else 1))
    moved = gk.mesh.TriangleMesh(cpu.mesh.vertices + 0.01 * cpu.mesh.diagonal, cpu.mesh.faces)
    both = gk.mesh.TriangleMesh(
        np.concatenate([cpu.mesh.vertices, moved.vertices]),
        np.concatenate([cpu.mesh.faces, moved.faces + len(moved.vertices)]),
    )
    for what, ask in (
        ("pairs of two meshes", lambda s: s.intersecting_triangles(gk.mesh.Surface(moved, device=s.device))),
        ("pairs within one mesh", lambda s: gk.mesh.Surface(both, device=s.device).self_intersections()),
    ):
        a, b = ask(cpu), ask(gpu)
        rows.append((f"{what}: differ", len(a), 0 if np.array_equal(a, b) else 1))
    rows.append(("what auto is: differs", 1, 0 if cpu.sign_method == gpu.sign_method else 1))


def check_containers(gpu, points, device, rows):
    expected = gpu.closest_point(points).distance
    on_device = wp.array(points, dtype=wp.float64, device=device)
    kinds = {
        "warp (N, 3)": on_device,
        "warp vec3d": wp.array(points, dtype=wp.vec3d, device=device),
        "warp on the CPU": wp.array(points, dtype=wp.vec3d, device="cpu"),
    }
    if on_device.device.is_cuda:
        kinds["CUDA array interface"] = CudaExporter(on_device)
    for name, given in kinds.items():
        found = gpu.closest_point(given).distance
        home = given.array.device if isinstance(given, CudaExporter) else given.device
        right = isinstance(found, wp.array) and found.device == home
        wrong = int((found.numpy() != expected).sum()) if right else len(points)
        rows.append((f"container {name}: wrong", len(points), wrong))
    single = gpu.closest_point(wp.array(points, dtype=wp.vec3f, device=device)).distance
    wrong = 0 if single.dtype == wp.float32 and np.allclose(single.numpy(), expected, atol=1e-6) else len(points)
    rows.append(("container warp vec3f: wrong", len(points), wrong))
    bad = points.copy()
    bad[77, 1] = np.nan
    try:
        gpu.closest_point(wp.array(bad, dtype=wp.vec3d, device=device))
        rows.append(("NaN on the device: refused with its row", 1, "no"))
    except gk.InputError as error:
        rows.append(("NaN on the device: refused with its row", 1, "yes" if "row 77" in str(error) else str(error)))


def check_leaks(gpu, device, rows):
    mesh = gpu.mesh
    inside = inputs.uniform(mesh, 20_000, 3)
    inside = inside[gpu.signed_distance(inside).distance < -0.02 * mesh.diagonal]
    leaks, count = 0, 0
    for seed in range(10):
        rays = inputs.aimed_rays(mesh, inside[seed % len(inside)], 1_000_000, seed)
        leaks += int((gpu.raycast(*rays).triangle_id < 0).sum())
        count += 1_000_000
    rows.append(("rays from inside at vertices and edges: leaks", count, leaks))


def rates(mesh, device, rows, count):
    """Median times against raw warp on arrays on the device, in random order."""
    surface = gk.mesh.Surface(mesh, device=device)
    center, scale = surface.origin, surface.scale
    size = f"{len(mesh.faces):,} triangles"

    def on_device(values, dtype):
        return wp.array(values, dtype=dtype, device=device)

    out = wp.empty(count, dtype=wp.float32, device=device)
    for name, points in (("uniform", inputs.uniform(mesh, count)), ("near", inputs.near(mesh, count))):
        local = on_device((points - center) / scale, wp.vec3)
        for label, dtype in (("float64", wp.vec3d), ("float32", wp.vec3f)):
            given = on_device(points, dtype)
            ours = median_seconds(lambda given=given: surface.closest_point(given), device)
            raw = median_seconds(
                lambda local=local: wp.launch(raw_closest_kernel, count, [surface.id, local], [out], device=device),
                device,
            )
            rows.append((f"closest point, {name}, {label}, {size}", count, ours, raw))
    for name, rays in (
        ("random", inputs.random_rays(mesh, count)),
        ("camera", inputs.camera_rays(mesh, 2000, count // 2000)),
    ):
        given = [on_device(a, wp.vec3d) for a in rays]
        local = [on_device((rays[0] - center) / scale, wp.vec3), on_device(rays[1] / scale, wp.vec3)]
        ours = median_seconds(lambda given=given: surface.raycast(*given), device)
        raw = median_seconds(
            lambda local=local: wp.launch(raw_ray_kernel, count, [surface.id, *local], [out], device=device), device
        )
        rows.append((f"first hit, {name}, {size}", count, ours, raw))
    for calls in (1, 100):
        few = on_device(inputs.uniform(mesh, calls), wp.vec3d)
        local = wp.array((few.numpy() - center) / scale, dtype=wp.vec3, device=device)
        ours = median_seconds(lambda few=few: surface.closest_point(few), device, runs=200)
        raw = median_seconds(
            lambda local=local: wp.launch(raw_closest_kernel, len(local), [surface.id, local], [out], device=device),
            device,
            runs=200,
        )
        rows.append((f"{calls} closest points, {size}", calls, ours, raw))
    for name, ask in (
        ("self-intersections", surface.self_intersections),
        ("what auto is", lambda: choose_sign(surface)),
    ):
        rows.append((f"{name}, {size}", len(mesh.faces), median_seconds(ask, device, runs=3), None))
    prepare = median_seconds(lambda: gk.mesh.Surface(mesh, device=device), device, runs=3)
    rows.append((f"Surface, {size}", len(mesh.faces), prepare, None))
    for voxels in (128, 256, 512):
        voxel = float((mesh.bounds[1] - mesh.bounds[0]).max()) / voxels
        made = gk.volume.from_mesh(surface, voxel)
        band = median_seconds(lambda voxel=voxel: gk.volume.from_mesh(surface, voxel), device, runs=3)
        rows.append((f"narrow band {voxels}^3, {size}", made.info.active_voxel_count, band, None))
    points = inputs.near(mesh, count)
    handle = made.id(device)
    raw_points = on_device(points, wp.vec3)
    raw = median_seconds(
        lambda: wp.launch(raw_sample_kernel, count, [handle, raw_points], [out], device=device), device
    )
    for label, dtype in (("float64", wp.vec3d), ("float32", wp.vec3f)):
        given = on_device(points, dtype)
        ours = median_seconds(lambda given=given: made.sample(given, device=device), device)
        rows.append((f"sample 512^3, near, {label}", count, ours, raw))


def neighbor_rates(device, rows, count):
    cloud = np.random.default_rng(6).random((count, 3))
    radius = float((30 / (4.19 * count)) ** (1 / 3))
    given = wp.array(cloud, dtype=wp.vec3d, device=device)
    grid = gk.points.NeighborGrid(given, radius, device=device)
    single = wp.array(cloud, dtype=wp.vec3, device=device)
    hashed = wp.HashGrid(256, 256, 256, device=device)
    hashed.build(single, radius)
    out = wp.empty(count, dtype=wp.int32, device=device)
    ours = median_seconds(lambda: grid.count(given), device)
    raw = median_seconds(
        lambda: wp.launch(raw_count_in_order_kernel, count, [hashed.id, single, radius], [out], device=device), device
    )
    rows.append(("neighbor counts, 30 each", count, ours, raw))
    build = median_seconds(lambda: gk.points.NeighborGrid(given, radius, device=device), device)
    raw = median_seconds(lambda: hashed.build(single, radius), device)
    rows.append(("NeighborGrid build", count, build, raw))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default=None, help="the device to compare with the CPU; default: the first GPU")
    parser.add_argument("--mesh", default=None, help=".npz with vertices and faces; default: the bunny")
    parser.add_argument("--count", type=int, default=4_000_000, help="queries of the timings")
    parser.add_argument("--out", default=None, help="folder for gpu_check.md")
    options = parser.parse_args()
    device = wp.get_device(options.device or "cuda:0")
    if options.mesh:
        arrays = np.load(options.mesh)
        mesh = gk.mesh.TriangleMesh(arrays["vertices"], arrays["faces"], name="bunny")
    else:
        mesh = inputs.bunny()
    lines = [f"Device: {device.name}; geokit {gk.__version__}, warp {wp.__version__}", ""]
    answers: list[tuple] = []
    compare(mesh, device.alias, answers)
    compare_deep(mesh, device.alias, answers)
    lines += ["| compared with the CPU | count | difference |", "|---|---:|---:|"]
    lines += [
        f"| {what} | {n:,} | {d:.2g} |" if isinstance(d, float) else f"| {what} | {n:,} | {d} |"
        for what, n, d in answers
    ]
    print("\n".join(lines), flush=True)
    timings: list[tuple] = []
    for times in (2, 4):
        rates(inputs.subdivided(mesh, times), device.alias, timings, options.count)
    neighbor_rates(device.alias, timings, options.count)
    table = ["", "| step | count | ms | M/s | raw warp ms | ratio |", "|---|---:|---:|---:|---:|---:|"]
    for what, n, ours, raw in timings:
        other = f"{raw * 1e3:.2f} | {raw / ours:.2f}" if raw else "- | -"
        table.append(f"| {what} | {n:,} | {ours * 1e3:.2f} | {n / ours / 1e6:.1f} | {other} |")
    print("\n".join(table))
    if options.out:
        Path(options.out, "gpu_check.md").write_text("\n".join(lines + table) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
