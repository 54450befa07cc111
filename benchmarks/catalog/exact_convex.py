"""Whether two convex bodies have a common point, exactly: float64 with its bound first, rationals for the rest."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from geokit.mesh import TriangleMesh

# Maps are rounded to multiples of this: of bodies whose corners are small whole numbers all sums are exact then.
STEP = 2.0**-22
# Far above the rounding of the comparisons below, of bodies a few units across.
SURE = 1e-9


def random_maps(rng: np.random.Generator, count: int, away: float, *, lattice: float = 0.1) -> np.ndarray:
    """Rigid maps (count, 4, 4) to 4e-7, shifted by up to ``away``; a share of them by quarter turns and whole numbers
    and halves, where bodies of whole numbers touch."""
    q = rng.normal(size=(count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    maps = np.tile(np.eye(4), (count, 1, 1))
    maps[:, :3, :3] = np.moveaxis(np.array(rows), -1, 0)
    maps[:, :3, 3] = rng.uniform(-away, away, (count, 3))
    regular = rng.random(count) < lattice
    axes = np.argsort(rng.random((count, 3)), axis=1)
    maps[regular, :3, :3] = (np.eye(3)[axes] * rng.choice([-1.0, 1.0], (count, 1, 3)))[regular]
    maps[regular, :3, 3] = np.round(2 * maps[regular, :3, 3]) / 2
    return np.round(maps / STEP) * STEP


def _directions(body: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """Normals and edges of a body of whole numbers, each direction once."""

    def distinct(rows: np.ndarray) -> np.ndarray:
        whole = rows.round().astype(np.int64)
        whole = whole // np.gcd.reduce(whole, axis=1)[:, None]
        first = np.take_along_axis(whole, (whole != 0).argmax(axis=1)[:, None], axis=1)
        return np.unique(whole * np.sign(first), axis=0).astype(float)

    ends = body.vertices[body.faces]
    sides = np.roll(ends, -1, axis=1) - ends
    normals = np.cross(sides[:, 0], sides[:, 1])
    pairs = np.sort(body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    # A diagonal of a flat side is no edge.
    edges = [
        e
        for e in np.unique(pairs, axis=0)
        if len(distinct(normals[np.repeat(np.arange(len(ends)), 3)[(pairs == e).all(axis=1)]])) > 1
    ]
    return distinct(normals), distinct(np.array([body.vertices[j] - body.vertices[i] for i, j in edges]))


def widest_gap(one: TriangleMesh, other: TriangleMesh, maps: np.ndarray) -> np.ndarray:
    """The widest gap between convex solids with corners of small whole numbers, ``one`` where each map is, along the
    normals of both and the cross products of their edges: minus their penetration depth where they meet."""
    normals, edges = zip(_directions(one), _directions(other), strict=True)
    linear = maps[:, :3, :3]
    turned = edges[0] @ linear.transpose(0, 2, 1)
    across = np.cross(turned[:, :, None], edges[1][None, None]).reshape(len(maps), -1, 3)
    fixed = np.broadcast_to(normals[1], (len(maps), *normals[1].shape))
    axes = np.concatenate([normals[0] @ np.linalg.inv(linear), fixed, across], axis=1)
    length = np.linalg.norm(axes, axis=2, keepdims=True)
    axes = np.divide(axes, length, out=np.full_like(axes, np.nan), where=length > 1e-4)
    a = one.vertices @ linear.transpose(0, 2, 1) + maps[:, None, :3, 3]
    along, beside = axes @ a.transpose(0, 2, 1), axes @ other.vertices.T
    gap = np.maximum(beside.min(axis=2) - along.max(axis=2), along.min(axis=2) - beside.max(axis=2))
    return np.nanmax(gap, axis=1)


def meet(one: TriangleMesh, other: TriangleMesh, maps: np.ndarray) -> np.ndarray:
    """Whether such solids have a common point, touching included."""
    widest = widest_gap(one, other, maps)
    found = widest <= 0.0
    for i in np.flatnonzero(np.abs(widest) < SURE):
        corners = one.vertices @ maps[i, :3, :3].T + maps[i, :3, 3]
        found[i] = _meet_exactly(corners, one, other)
    return found


def _meet_exactly(corners: np.ndarray, one: TriangleMesh, other: TriangleMesh) -> bool:
    def cross(a: list, b: list) -> list:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    bodies = [[[Fraction(x) for x in row] for row in rows.tolist()] for rows in (corners, other.vertices)]
    axes, edges = [], []
    for points, mesh in zip(bodies, (one, other), strict=True):
        faces = mesh.faces.tolist()
        sides = {(min(i, j), max(i, j)) for f in faces for i, j in zip(f, f[1:] + f[:1], strict=True)}
        edge = {s: [points[s[1]][k] - points[s[0]][k] for k in range(3)] for s in sides}
        axes += [cross(edge[min(a, b), max(a, b)], edge[min(b, c), max(b, c)]) for a, b, c in faces]
        edges.append(list(edge.values()))
    axes += [cross(a, b) for a in edges[0] for b in edges[1]]
    for axis in axes:
        along, beside = ([sum(x * y for x, y in zip(axis, p, strict=True)) for p in points] for points in bodies)
        if max(along) < min(beside) or max(beside) < min(along):
            return False
    return True
