"""Contacts of two bodies in random poses: ``python -m benchmarks.contacts [--count N] [--exact N]``.

Which poses touch is compared with exact arithmetic first (``benchmarks/catalog/exact_convex.py``): how many are missed,
and how many are said to touch that do not. Rates are poses per second of processor time, of all threads together.

- geokit: ``Surface.contacts``, all poses in one call, with regions, depths and their bounds.
- geokit distance: ``Surface.distance`` alone.
- fcl: ``collide`` of two BVHModels in a loop, of surfaces; up to 100 contacts each.
- MuJoCo: convex meshes, one of them on a free joint; ``mj_kinematics`` and ``mj_collision`` in a loop.
- newton: convex hulls, a world for each pose, all in one call of ``Model.collide``; up to MOST_WORLDS poses.

Peers that are not installed are left out. Bodies that are not convex have no exact answer here: geokit's distance gives
it, with the poses in which one is inside of the other.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import geokit as gk
from benchmarks.catalog import exact_convex

TETRAHEDRON = gk.mesh.TriangleMesh(
    [[-1.0, -1, -1], [2, 0, 0], [0, 2, 0], [0, 0, 2]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
)
BOX = gk.mesh.box((2, 2, 2))
CONVEX = {"tetrahedron, box": (TETRAHEDRON, BOX), "box, box": (BOX, BOX)}
MOST_WORLDS = 2000
# Poses that the exact comparison takes at a time.
BLOCK = 20_000

Touching = Callable[[np.ndarray], np.ndarray]


def by_geokit(one: gk.mesh.TriangleMesh, other: gk.mesh.TriangleMesh) -> Touching:
    first, second = (gk.mesh.Surface(mesh, device="cpu") for mesh in (one, other))
    return lambda maps: np.diff(first.contacts(second, transform=maps).offsets) > 0


def by_distance(one: gk.mesh.TriangleMesh, other: gk.mesh.TriangleMesh) -> Touching:
    first, second = (gk.mesh.Surface(mesh, device="cpu") for mesh in (one, other))
    return lambda maps: first.distance(second, transform=maps).distance == 0.0


def by_fcl(one: gk.mesh.TriangleMesh, other: gk.mesh.TriangleMesh) -> Touching:
    import fcl

    def model(mesh: gk.mesh.TriangleMesh) -> Any:
        made = fcl.BVHModel()
        made.beginModel(mesh.vertex_count, mesh.face_count)
        made.addSubModel(mesh.vertices, mesh.faces)
        made.endModel()
        return fcl.CollisionObject(made)

    first, second = model(one), model(other)

    def run(maps: np.ndarray) -> np.ndarray:
        found = np.zeros(len(maps), bool)
        for i, map in enumerate(maps):
            first.setTransform(fcl.Transform(map[:3, :3], map[:3, 3]))
            request = fcl.CollisionRequest(num_max_contacts=100, enable_contact=True)
            found[i] = fcl.collide(first, second, request, fcl.CollisionResult()) > 0
        return found

    return run


def by_mujoco(one: gk.mesh.TriangleMesh, other: gk.mesh.TriangleMesh) -> Touching:
    import mujoco

    def asset(name: str, mesh: gk.mesh.TriangleMesh) -> str:
        vertices = " ".join(map(str, mesh.vertices.ravel()))
        return f'<mesh name="{name}" vertex="{vertices}" face="{" ".join(map(str, mesh.faces.ravel()))}"/>'

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset>{asset("a", one)}{asset("b", other)}</asset><worldbody><geom type="mesh" mesh="b"/>'
        '<body><freejoint/><geom type="mesh" mesh="a"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)

    def run(maps: np.ndarray) -> np.ndarray:
        found = np.zeros(len(maps), bool)
        for i, map in enumerate(maps):
            mujoco.mju_mat2Quat(data.qpos[3:7], map[:3, :3].ravel())
            data.qpos[:3] = map[:3, 3]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            found[i] = data.ncon > 0
        return found

    return run


def by_newton(one: gk.mesh.TriangleMesh, other: gk.mesh.TriangleMesh) -> Touching:
    import newton
    import warp as wp

    def run(maps: np.ndarray) -> np.ndarray:
        maps = maps[:MOST_WORLDS]
        world, scene = newton.ModelBuilder(), newton.ModelBuilder()
        for body, mesh in ((world.add_body(), one), (-1, other)):
            hull = newton.Mesh(mesh.vertices.astype(np.float32), mesh.faces.ravel())
            world.add_shape_convex_hull(body, mesh=hull, cfg=newton.ModelBuilder.ShapeConfig(gap=0.0, margin=0.0))
        scene.replicate(world, len(maps))
        model = scene.finalize(device="cpu")
        state, poses = model.state(), np.zeros((len(maps), 7), np.float32)
        poses[:, :3] = maps[:, :3, 3]
        for row, map in zip(poses, maps, strict=True):
            row[3:] = wp.quat_from_matrix(wp.mat33(*map[:3, :3].ravel().tolist()))
        state.body_q.assign(poses)
        begin = time.process_time()
        found = model.collide(state)
        count = int(found.rigid_contact_count.numpy()[0])
        run.seconds = time.process_time() - begin  # type: ignore[attr-defined]
        world_of = model.shape_world.numpy()[found.rigid_contact_shape0.numpy()[:count]]
        return np.isin(np.arange(len(maps)), world_of)

    return run


WAYS: dict[str, Callable[..., Touching]] = {
    "geokit": by_geokit,
    "geokit distance": by_distance,
    "fcl": by_fcl,
    "MuJoCo": by_mujoco,
    "newton": by_newton,
}


def row_of(name: str, way: Touching, maps: np.ndarray, expected: np.ndarray | None) -> str:
    way(maps[:100])
    begin = time.process_time()
    found = way(maps)
    seconds = getattr(way, "seconds", time.process_time() - begin)
    missed = extra = "-"
    if expected is not None:
        expected = expected[: len(found)]
        missed, extra = str((expected & ~found).sum()), str((found & ~expected).sum())
    return f"| {name} | {len(found)} | {found.mean():.3f} | {missed} | {extra} | {len(found) / seconds:,.0f} |"


def compare_exactly(count: int) -> None:
    """Of many poses only how many are missed, and how many are said to touch that do not."""
    rng = np.random.default_rng(1)
    for bodies, (one, other) in CONVEX.items():
        way, missed, extra, touching = by_geokit(one, other), 0, 0, 0
        for begin in range(0, count, BLOCK):
            maps = exact_convex.random_maps(rng, min(BLOCK, count - begin), 3.0, lattice=0.002)
            expected, found = exact_convex.meet(one, other, maps), way(maps)
            touching += int(expected.sum())
            missed, extra = missed + int((expected & ~found).sum()), extra + int((found & ~expected).sum())
        print(f"{bodies}: {count} poses, {touching} touch; {missed} missed, {extra} more than touch", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument(
        "--exact", type=int, default=0, help="compare as many poses with exact arithmetic, and no peers"
    )
    given = parser.parse_args()
    if given.exact:
        return compare_exactly(given.exact)
    bracket = gk.mesh.load(gk.sample_path("bracket.obj"))
    ball = gk.mesh.sphere(radius=0.3 * bracket.diagonal, segments=36)
    cases = {**CONVEX, "bracket, sphere": (bracket, ball)}
    print("| bodies, way | poses | touch | missed | more than touch | poses/s |")
    print("|---|---:|---:|---:|---:|---:|")
    for bodies, (one, other) in cases.items():
        away = 3.0 if bodies in CONVEX else 0.6 * bracket.diagonal
        maps = exact_convex.random_maps(np.random.default_rng(0), given.count, away, lattice=0.005)
        expected = exact_convex.meet(one, other, maps) if bodies in CONVEX else None
        for name, make in WAYS.items():
            if bodies not in CONVEX and name in ("MuJoCo", "newton"):  # which take the convex hull
                continue
            try:
                way = make(one, other)
            except ImportError as error:
                print(f"| {bodies}: {name} | | {error} | | | |")
                continue
            print(row_of(f"{bodies}: {name}", way, maps, expected), flush=True)
    return None


if __name__ == "__main__":
    main()
