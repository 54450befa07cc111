"""What ``mesh.wrap`` promises, held against soups: ``python -m benchmarks.wraps --count N --seed S --jobs J``.

Soup i of a seed is a shape with damage of kind i modulo 9, half the time with damage of another kind on top; its size,
place, tolerance and gap are drawn, and an offset for a tenth of them. Each promise is looked at in NumPy and SciPy
alone: edges and fans are counted, segments are cut with triangles, distances are those of samples to all triangles that
can be nearest, points are inside by their solid angle. The table is by kind; a promise that is broken is named with the
soup's number, and ``--first I --count 1`` makes that soup again.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import geokit as gk
from benchmarks import inputs, scenes
from benchmarks.catalog import mesh_catalog as catalog
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh import TriangleMesh

Random = np.random.Generator
Points = NDArray[np.float64]

SAMPLES = Path(__file__).parents[1] / "data" / "samples"
FEWEST, MOST = 50, 20_000
# Seconds after which a wrap hangs.
PATIENCE = 900
# Pieces of triangles, beyond which none is cut.
MOST_PIECES = 200_000
# Samples on faces of the wrap, points of the soup.
ON_WRAP, ON_SOUP = 1500, 600
# So many of the farthest samples, and others on their faces, so many times nearer to them.
BEST, TRIES, CLOSER = 40, 8, (1.0, 0.5, 0.25, 0.1, 0.03)
# Solid angles, or segments beside triangles, that are computed for one soup at most, and at a time.
ANGLES, AT_A_TIME = 4_000_000, 1_000_000
# Share of the size of the soup that distances in float64 may be off.
ROUNDING = 1e-12


class Soup(NamedTuple):
    name: str
    mesh: TriangleMesh
    tolerance: float
    gap: float
    cavities: bool
    offset: float


# Shapes of about so many faces.


def _torus(count: int) -> TriangleMesh:
    across = max(3, round((count / 4) ** 0.5))
    return catalog.torus(2 * across, across)


def _scene(name: str, count: int) -> TriangleMesh:
    return scenes.SCENES[name](count).mesh


SHAPES: dict[str, Callable[[int], TriangleMesh]] = {
    **{made.__name__: lambda _, made=made: made() for made in (*catalog.CLOSED, *catalog.OPEN, *catalog.DEFECTIVE)},
    "icosphere": lambda count: catalog.icosphere(round(np.log(count / 20) / np.log(4))),
    "torus": _torus,
    "open_shell": lambda count: catalog.open_shell(max(2, round((count / 2) ** 0.5))),
    "cone": lambda count: catalog.cone(max(3, count // 2), 2.0),
    **{name: partial(_scene, name) for name in scenes.SCENES},
    **{name: lambda _, name=name: gk.mesh.load(SAMPLES / name) for name in ("bracket.obj", "shell.stl", "broken.obj")},
}


# Damage by kind.


def holes(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    seed = int(random.integers(1 << 30))
    if random.random() < 0.3:
        mesh = catalog.with_large_hole(mesh, random.uniform(0.02, 0.5), seed)
    return catalog.with_holes(mesh, random.uniform(0.01, 0.4), seed)


def flips(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    return catalog.with_flips(mesh, random.uniform(0.02, 0.6), int(random.integers(1 << 30)))


def duplicates(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    """Faces again: as they are, wound the other way, and moved by next to nothing; and faces that are none."""
    seed = int(random.integers(1 << 30))
    twice = catalog.doubled(catalog.with_duplicates(mesh, random.uniform(0.05, 1.0), seed), slice(0, None, 3))
    near = catalog.moved(mesh, tuple(mesh.diagonal * 10 ** random.uniform(-16, -4) * random.normal(size=3)))
    corners = random.integers(mesh.vertex_count, size=(5, 2))
    joined = catalog.join(twice, near)
    return TriangleMesh(joined.vertices, np.concatenate([joined.faces, corners[:, [0, 1, 1]]]))


def crossings(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    other = catalog.turned(_centered(mesh), int(random.integers(1 << 30)))
    other = catalog.moved(_centered(other), tuple(0.1 * mesh.diagonal * random.normal(size=3)))
    copies = catalog.overlapping_copies(_centered(mesh), int(random.integers(1, 4)), int(random.integers(1 << 30)))
    return catalog.join(copies, other)


def sheets(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    """Flattened, and often once more beside it."""
    axis, thin = int(random.integers(3)), 0.0 if random.random() < 0.2 else 10 ** random.uniform(-7, -1)
    flat = TriangleMesh(mesh.vertices * np.where(np.arange(3) == axis, thin, 1.0), mesh.faces)
    if random.random() < 0.5:
        return flat
    return catalog.join(
        flat, catalog.moved(flat, tuple(np.eye(3)[axis] * mesh.diagonal * 10 ** random.uniform(-5, -0.5)))
    )


def leaves(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    """Each face alone, shrunken, turned and moved."""
    corners = mesh.vertices[mesh.faces]
    center = corners.mean(axis=1, keepdims=True)
    size = random.uniform(0.2, 1.5, (len(corners), 1, 1))
    turn = np.linalg.qr(random.normal(size=(len(corners), 3, 3)))[0] if random.random() < 0.7 else np.eye(3)
    moved = mesh.diagonal * 10 ** random.uniform(-4, -1) * random.normal(size=center.shape)
    return _of_corners((corners - center) * size @ turn + center + moved)


def nested(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    mesh = _centered(mesh)
    inner = [catalog.scaled(mesh, size) for size in random.uniform(-0.97, 0.97, int(random.integers(1, 4)))]
    return catalog.join(mesh, *inner)


def noise(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    if random.random() < 0.5:
        mesh = catalog.soup(mesh)
    moved = mesh.diagonal * 10 ** random.uniform(-5, -1.3) * random.normal(size=mesh.vertices.shape)
    return TriangleMesh(mesh.vertices + moved, mesh.faces)


def clouds(mesh: TriangleMesh, random: Random) -> TriangleMesh:
    """Points alone, with noise."""
    points = _on_faces(mesh, min(MOST, mesh.face_count), random)
    points = points + mesh.diagonal * 10 ** random.uniform(-5, -1.5) * random.normal(size=points.shape)
    return TriangleMesh(points, np.repeat(np.arange(len(points))[:, None], 3, axis=1))


KINDS = (holes, flips, duplicates, crossings, sheets, leaves, nested, noise, clouds)


def _centered(mesh: TriangleMesh) -> TriangleMesh:
    return catalog.moved(mesh, tuple(-mesh.bounds.mean(axis=0)))


def _of_corners(corners: Points) -> TriangleMesh:
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def made(seed: int, number: int) -> Soup:
    random = np.random.default_rng([seed, number])
    kind, name = KINDS[number % len(KINDS)], str(random.choice(list(SHAPES)))
    count = int(10 ** random.uniform(np.log10(FEWEST), np.log10(MOST)))
    mesh = SHAPES[name](count)
    while mesh.face_count < max(FEWEST, count / 4):
        mesh = inputs.subdivided(mesh, 1)
    mesh = catalog.turned(mesh, number) if random.random() < 0.7 else mesh
    second = KINDS[int(random.integers(len(KINDS) - 1))] if random.random() < 0.5 else kind
    names = f"{name} {kind.__name__}"
    if second is not kind:
        mesh, names = second(mesh, random), f"{name} {second.__name__} {kind.__name__}"
    mesh = kind(mesh, random)
    if mesh.face_count > MOST:
        mesh = TriangleMesh(mesh.vertices, mesh.faces[np.sort(random.permutation(mesh.face_count)[:MOST])])
    vertices = _centered(mesh).vertices * 10 ** random.uniform(-4, 4)
    size = float(np.linalg.norm(np.ptp(vertices[mesh.faces].reshape(-1, 3), axis=0)))
    if random.random() < 0.2:
        vertices = vertices + size * 10 ** random.uniform(0, 6) * random.normal(size=3)
    tolerance = size * 10 ** random.uniform(-1.75, -0.7)
    gap = min(tolerance * 10 ** random.uniform(-1.5, 0.9), 0.5 * size) if random.random() < 0.5 else 0.0
    cavities = bool(random.random() < 0.2)
    offset = min(tolerance * 10 ** random.uniform(-1.0, 1.2), 0.3 * size) if random.random() < 0.1 else 0.0
    return Soup(names, TriangleMesh(vertices, mesh.faces), tolerance, gap, cavities, offset)


# What is promised, by other ways than those of geokit.


def _on_faces(mesh: TriangleMesh, count: int, random: Random, rows: Any = slice(None)) -> Points:
    """Points on faces by area; on any of them if there is none."""
    corners = mesh.vertices[mesh.faces[rows]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = area / area.sum() if area.sum() > 0.0 else None
    chosen = corners[random.choice(len(corners), count, p=share)]
    return np.einsum("nk,nkj->nj", random.dirichlet((1.0, 1.0, 1.0), count), chosen)


def _to_segments(points: Points, a: Points, b: Points) -> Points:
    way = b - a
    length = np.einsum("nj,nj->n", way, way)
    t = np.clip(np.einsum("nj,nj->n", points - a, way) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    return np.linalg.norm(points - a - t[:, None] * way, axis=1)


def _to_triangles(points: Points, corners: Points) -> Points:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    best = np.minimum(np.minimum(_to_segments(points, a, b), _to_segments(points, b, c)), _to_segments(points, c, a))
    normal = np.cross(b - a, c - a)
    inner = np.einsum("nj,nj->n", normal, normal) > 0.0
    for start, end in ((a, b), (b, c), (c, a)):
        inner &= np.einsum("nj,nj->n", np.cross(end - start, points - start), normal) >= 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.abs(np.einsum("nj,nj->n", points - a, normal)) / np.linalg.norm(normal, axis=1)
    return np.where(inner, np.minimum(best, height), best)


def _bisected(corners: Points, most: float) -> Points:
    """The triangles, cut across their longest edges until these are short or there are many."""
    done = []
    while len(corners) and sum(map(len, done)) + len(corners) < MOST_PIECES:
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = sides.max(axis=1) > most
        done.append(corners[~long])
        a, b, c = (
            np.take_along_axis(corners[long], (sides[long].argmax(axis=1)[:, None, None] + k) % 3, 1)[:, 0]
            for k in range(3)
        )
        corners = np.concatenate([np.stack([a, (a + b) / 2, c], axis=1), np.stack([(a + b) / 2, b, c], axis=1)])
    return np.concatenate([*done, corners])


def distances(points: Points, mesh: TriangleMesh) -> Points:
    """Distances to the triangles, of all whose pieces can be nearest: those in reach of a center, by sizes."""
    corners = _bisected(mesh.vertices[mesh.faces], mesh.diagonal / 50.0)
    center = corners.mean(axis=1)
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    best = cKDTree(np.concatenate([center, corners.reshape(-1, 3)])).query(points)[0]
    size = np.ceil(np.log2(np.maximum(radius, 1e-6 * radius.max() + 1e-300)))
    for one in np.unique(size):
        rows = np.flatnonzero(size == one)
        near = cKDTree(center[rows]).query_ball_point(points, (best + radius[rows].max()) * (1.0 + 1e-9))
        count = np.array([len(found) for found in near])
        for some in np.array_split(np.arange(len(points)), 1 + int(count.sum()) // AT_A_TIME):
            asked = np.repeat(some, count[some])
            if len(asked):
                them = rows[np.concatenate([near[i] for i in some]).astype(np.int64)]
                np.minimum.at(best, asked, _to_triangles(points[asked], corners[them]))
    return best


def windings(points: Points, mesh: TriangleMesh) -> Points:
    """Winding numbers by the solid angles of all faces (van Oosterom and Strackee)."""
    found = []
    for some in np.array_split(points, 1 + len(points) * mesh.face_count // AT_A_TIME):
        way = mesh.vertices[mesh.faces][None] - some[:, None, None]
        a, b, c = (way[:, :, k] for k in range(3))
        x, y, z = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        dots = [np.einsum("pfj,pfj->pf", *pair) for pair in ((a, b), (b, c), (c, a))]
        high = np.einsum("pfj,pfj->pf", a, np.cross(b, c))
        found.append(np.arctan2(high, x * y * z + dots[0] * z + dots[1] * x + dots[2] * y).sum(axis=1) / (2.0 * np.pi))
    return np.concatenate(found)


def _beside(low: tuple[Points, Points], high: tuple[Points, Points]) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Pairs of boxes that overlap, in blocks."""
    width = sum((top - bottom).mean(axis=0) for bottom, top in zip(low, high, strict=True))
    axis = int(np.argmin(width / np.maximum(np.ptp(np.concatenate(low), axis=0), 1e-300)))
    for one, other, strict in ((0, 1, False), (1, 0, True)):
        order = np.argsort(low[other][:, axis])
        starts = low[other][order, axis]
        first = np.searchsorted(starts, low[one][:, axis], side="right" if strict else "left")
        count = np.maximum(np.searchsorted(starts, high[one][:, axis], side="right") - first, 0)
        for some in np.array_split(np.arange(len(count)), 1 + int(count.sum()) // AT_A_TIME):
            rows = np.repeat(some, count[some])
            before = np.cumsum(count[some]) - count[some]
            there = order[np.arange(len(rows)) - np.repeat(before - first[some], count[some])]
            meet = (low[one][rows] <= high[other][there]).all(axis=1) & (low[other][there] <= high[one][rows]).all(
                axis=1
            )
            pair = rows[meet], there[meet]
            yield (pair[1], pair[0]) if strict else pair


def cuts(edges: NDArray[Any], of_edges: Points, faces: NDArray[Any], of_faces: Points, shared: bool) -> int:
    """Pairs of edge and face that cross for certain in float64, but for those with a vertex in common if shared."""
    ends, corners = of_edges[edges], of_faces[faces]
    found = 0
    for edge, face in _beside((ends.min(axis=1), corners.min(axis=1)), (ends.max(axis=1), corners.max(axis=1))):
        if shared:
            apart = (edges[edge][:, :, None] != faces[face][:, None]).all(axis=(1, 2))
            edge, face = edge[apart], face[apart]
        (p, q), (a, b, c) = ends[edge].swapaxes(0, 1), corners[face].swapaxes(0, 1)
        size = np.abs(corners[face] - p[:, None]).max(axis=(1, 2), initial=0.0) + np.abs(q - p).max(axis=1, initial=0.0)

        def side(s: Points, t: Points, u: Points, v: Points, size: Points = size) -> Points:
            volume = np.einsum("nj,nj->n", t - s, np.cross(u - s, v - s))
            return np.where(np.abs(volume) > 1e-14 * size**3, np.sign(volume), 0.0)

        over = side(p, a, b, c) * side(q, a, b, c) < 0.0
        turns = np.stack([side(p, q, a, b), side(p, q, b, c), side(p, q, c, a)])
        found += int((over & (np.abs(turns.sum(axis=0)) == 3.0)).sum())
    return found


def faults(mesh: TriangleMesh) -> list[str]:
    """What is wrong with edges and vertices, and the number of pieces and handles."""
    faces = mesh.faces.astype(np.int64)
    heads = np.concatenate([faces, np.roll(faces, -1, axis=1)], axis=0).reshape(2, -1)
    key, back = heads[0] * mesh.vertex_count + heads[1], heads[1] * mesh.vertex_count + heads[0]
    wrong = []
    if len(np.unique(key)) < len(key) or not np.array_equal(np.sort(key), np.sort(back)):
        wrong.append("not closed, manifold and oriented")
    # Corners of one vertex hang together by the edges at it, if it is manifold: as many sets as vertices.
    order, match = np.argsort(key), np.argsort(back)
    corner = np.arange(len(key))
    after = corner // 3 * 3 + (corner + 1) % 3
    # An edge from corner to after; its twin starts at the vertex of after.
    links = coo_array((np.ones(len(key)), (after[match], order)), (len(key), len(key)))
    fans = connected_components(links, directed=False)[0]
    if fans != len(np.unique(faces)) or fans != mesh.vertex_count:
        wrong.append(f"{fans} fans at {mesh.vertex_count} vertices")
    return wrong


def pieces(mesh: TriangleMesh) -> tuple[NDArray[Any], int]:
    """The piece of each face, and the handles of all together."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    links = coo_array((np.ones(len(edges)), tuple(edges.T)), (mesh.vertex_count,) * 2)
    count, label = connected_components(links, directed=False)
    return label[mesh.faces[:, 0]], count - (mesh.vertex_count - mesh.face_count // 2) // 2


def _farthest(mesh: TriangleMesh, given: TriangleMesh, random: Random, sign: float = 1.0) -> float:
    """The largest distance of points of a mesh that is found: of samples, and of others ever nearer to the farthest.

    With a sign of -1 it is the least, below zero.
    """
    rows = np.concatenate([np.arange(mesh.face_count), random.integers(mesh.face_count, size=ON_WRAP)])
    rows = rows[random.permutation(len(rows))[:ON_WRAP]]
    shares = random.dirichlet((0.7, 0.7, 0.7), len(rows))
    points = np.concatenate([mesh.vertices, np.einsum("nk,nkj->nj", shares, mesh.vertices[mesh.faces[rows]])])
    face = np.concatenate([np.zeros(mesh.vertex_count, np.int64), rows])
    face[mesh.faces.ravel()] = np.repeat(np.arange(mesh.face_count), 3)
    kept = random.permutation(len(face))[: 3 * ON_WRAP]
    points, face = points[kept], face[kept]
    far = sign * distances(points, given)
    for share in CLOSER:
        best = np.argsort(far)[-BEST:]
        face, points, far = face[best], points[best], far[best]
        aim = random.dirichlet((1.0, 1.0, 1.0), (TRIES, len(best)))
        others = points + share * (np.einsum("tnk,nkj->tnj", aim, mesh.vertices[mesh.faces[face]]) - points)
        points, face = np.concatenate([points, others.reshape(-1, 3)]), np.tile(face, TRIES + 1)
        far = np.concatenate([far, sign * distances(others.reshape(-1, 3), given)])
    return float(far.max())


def look(soup: Soup, found: Any, random: Random) -> tuple[list[str], int, float]:
    """Broken promises, pairs that cross, and the largest distance of samples."""
    middle = soup.mesh.bounds.mean(axis=0)
    given = TriangleMesh(soup.mesh.vertices - middle, soup.mesh.faces)
    mesh = TriangleMesh(found.mesh.vertices - middle, found.mesh.faces)
    wrong = faults(mesh)
    label, genus = pieces(mesh)
    if (found.component_count, found.genus) != (len(np.unique(label)), genus):
        wrong.append(f"{len(np.unique(label))} pieces and {genus} handles, not {found.component_count}, {found.genus}")
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    volume = np.bincount(label, np.einsum("nj,nj->n", a, np.cross(b, c)) / 6.0)
    if (volume[np.unique(label)] <= 0.0).any() and not soup.cavities:
        wrong.append("a piece is inside out")
    faces = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = np.unique(np.sort(faces, axis=1), axis=0)
    crossing = cuts(edges, mesh.vertices, mesh.faces, mesh.vertices, shared=True)
    touching = cuts(edges, mesh.vertices, given.faces, given.vertices, shared=False)
    sides = np.concatenate([given.faces[:, [0, 1]], given.faces[:, [1, 2]], given.faces[:, [2, 0]]])
    touching += cuts(np.unique(np.sort(sides, axis=1), axis=0), given.vertices, mesh.faces, mesh.vertices, shared=False)
    if crossing or touching:
        wrong.append(f"{crossing} crossings, {touching} with the soup")
    deviation = _farthest(mesh, given, random) - soup.offset
    slack = ROUNDING * (soup.mesh.diagonal + soup.offset + np.abs(middle).max())
    if soup.offset and (nearest := -_farthest(mesh, given, random, -1.0)) < soup.offset - slack:
        wrong.append(f"{nearest:g} from the soup, {soup.offset:g} promised")
    if deviation > found.deviation + slack:
        wrong.append(f"deviation {deviation:g}, {found.deviation:g} promised")
    if found.deviation > soup.tolerance + soup.gap:
        wrong.append(f"{found.deviation:g} promised, {soup.tolerance + soup.gap:g} wanted")
    away = (
        distances(mesh.vertices, given) > soup.offset + soup.tolerance
        if soup.gap
        else np.zeros(mesh.vertex_count, bool)
    )
    if (away[mesh.faces].any(axis=1) != found.bridges).mean() > 1e-3:
        wrong.append("bridges are others")
    count = max(20, min(ON_SOUP, ANGLES // mesh.face_count))
    used = given.vertices[np.unique(given.faces)]
    inner = np.concatenate([_on_faces(given, count // 2, random), used[random.permutation(len(used))[: count // 2]]])
    way = random.normal(size=inner.shape)
    inner = inner + soup.offset * way / np.linalg.norm(way, axis=1, keepdims=True)
    outside = np.abs(windings(inner, mesh) - 1.0) > 1e-6
    if outside.any():
        wrong.append(f"{int(outside.sum())} of {len(inner)} points of the soup are outside")
    return wrong, crossing, deviation


def _hangs(*_: Any) -> None:
    raise TimeoutError(f"no answer in {PATIENCE} s")


def trial(seed: int, number: int) -> dict[str, Any]:
    soup = made(seed, number)
    size = soup.mesh.diagonal
    row: dict[str, Any] = {
        "number": number,
        "kind": KINDS[number % len(KINDS)].__name__,
        "name": f"{soup.name} of {soup.mesh.face_count} faces, tolerance {soup.tolerance / size:.4f}, "
        f"gap {soup.gap / size:.4f}, offset {soup.offset / size:.4f} of the diagonal"
        f"{', cavities' if soup.cavities else ''}",
        "wrong": [],
    }
    begun = time.process_time()
    signal.signal(signal.SIGALRM, _hangs)
    signal.alarm(PATIENCE)
    try:
        lengths = {"tolerance": soup.tolerance, "gap": soup.gap, "offset": soup.offset}
        found = gk.mesh.wrap(soup.mesh, **lengths, cavities=soup.cavities, device="cpu")
    except (InputError, DeviceMemoryError) as error:
        return row | {"refused": str(error)}
    except BaseException:  # a hang, or what no promise allows: named with its place
        return row | {"wrong": [traceback.format_exc()]}
    finally:
        signal.alarm(0)
    row |= {"seconds": time.process_time() - begun, "faces": found.mesh.face_count}
    row["wrong"], row["crossing"], row["true"] = look(soup, found, np.random.default_rng([seed, number, 1]))
    return row | {"promised": found.deviation, "used": found.deviation / (soup.tolerance + soup.gap)}


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| kind | soups | wrapped | promises broken | pairs that cross | overstated: median, worst | faces | s |"
    yield "|---|---:|---:|---:|---:|---:|---:|---:|"
    for kind in [*(kind.__name__ for kind in KINDS), "all"]:
        of_kind = [row for row in rows if kind in (row["kind"], "all")]
        done = [row for row in of_kind if "true" in row]
        if done:
            over = np.array([row["promised"] / row["true"] for row in done])
            faces, seconds = (np.median([row[key] for row in done]) for key in ("faces", "seconds"))
            broken, pairs = sum(bool(row["wrong"]) for row in of_kind), sum(row["crossing"] for row in done)
            yield (
                f"| {kind} | {len(of_kind)} | {len(done)} | {broken} | {pairs} | {np.median(over):.3f}, "
                f"{over.max():.3f} | {faces:,.0f} | {seconds:.1f} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--log", type=Path, help="file that a line of JSON is added to for each soup")
    given = parser.parse_args()
    rows = []
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        numbers = range(given.first, given.first + given.count)
        for done in as_completed([pool.submit(trial, given.seed, number) for number in numbers]):
            rows.append(row := done.result())
            for text in [*row["wrong"], *([row["refused"]] if "refused" in row else [])]:
                print(f"{row['number']}: {row['name']}: {text}", file=sys.stderr, flush=True)
            if given.log:
                with given.log.open("a") as log:
                    log.write(json.dumps(row) + "\n")
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
