"""Meshes by trait, for all tests: each function returns a TriangleMesh and says what is known about it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geokit.mesh.model.triangle_mesh import MeshPart, TriangleMesh

__all__ = [
    "CLOSED",
    "DEFECTIVE",
    "OPEN",
    "bowtie",
    "box",
    "box_without_a_lid",
    "collapsed_faces",
    "crossing_sheets",
    "doubled",
    "duplicate_faces",
    "far_away",
    "flipped_faces",
    "holed_sphere",
    "icosphere",
    "inside_out_box",
    "join",
    "l_profile",
    "moved",
    "nested_boxes",
    "open_cylinder",
    "open_shell",
    "overlapping_spheres",
    "scaled",
    "sheet",
    "single_triangle",
    "sliver_fan",
    "soup",
    "spherical_cap",
    "tetrahedron",
    "three_on_an_edge",
    "torus",
    "two_boxes_touching_at_a_vertex",
    "unreferenced_vertices",
    "zero_area_triangles",
]


def single_triangle() -> TriangleMesh:
    """A right triangle of area 1/2 in the plane z = 0."""
    return TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], name="single_triangle")


def tetrahedron() -> TriangleMesh:
    """Closed; corners of the unit axes: volume 1/6, area (3 + sqrt(3)) / 2."""
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    return TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], faces, name="tetrahedron")


_BOX_FACES = np.array(
    [
        [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
    ]
)  # fmt: skip


def box(lower: tuple[float, float, float] = (0, 0, 0), upper: tuple[float, float, float] = (1, 1, 1)) -> TriangleMesh:
    """Closed; vertex 4 z + 2 y + x stands at the upper (1) or lower (0) end of each axis."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    return TriangleMesh(np.where(corners == 1, high, low), _BOX_FACES, name="box")


def inside_out_box() -> TriangleMesh:
    """Closed and consistently wound, but clockwise seen from outside: signed volume -1."""
    return TriangleMesh(box().vertices, _BOX_FACES[:, ::-1], name="inside_out_box")


def nested_boxes() -> TriangleMesh:
    """Closed; a box of edge 3 with a cavity of edge 1 in it (its faces look into the cavity): volume 26."""
    inner = box((1, 1, 1), (2, 2, 2))
    return join(box((0, 0, 0), (3, 3, 3)), TriangleMesh(inner.vertices, inner.faces[:, ::-1], name="cavity"))


def icosphere(subdivisions: int = 2, radius: float = 1.0) -> TriangleMesh:
    """Closed; vertices on the sphere around the origin, 20 * 4**subdivisions faces."""
    golden = (1 + np.sqrt(5)) / 2
    vertices = [(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    corners = np.array([np.roll(vertex, shift) for shift in range(3) for vertex in vertices])
    # The faces of an icosahedron are the triples of corners at the edge length 2.
    near = np.isclose(np.linalg.norm(corners[:, None] - corners[None], axis=2), 2.0)
    faces = np.array(
        [(a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[c, a]]
    )
    inward = np.einsum("ij,ij->i", np.cross(*_edges(corners, faces)), corners[faces].sum(axis=1)) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        corners, faces = _subdivided(corners, faces)
    corners = corners / np.linalg.norm(corners, axis=1, keepdims=True) * radius
    return TriangleMesh(corners, faces, name="icosphere")


def _edges(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return b - a, c - a


def _subdivided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (inverse.reshape(3, -1) + len(vertices)).tolist()
    a, b, c = faces.T.tolist()
    middle = vertices[unique].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    corners = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    finer = np.concatenate([np.transpose(t) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return np.concatenate([corners, middle]), finer


def torus(around: int = 48, across: int = 24, major: float = 1.0, minor: float = 0.35) -> TriangleMesh:
    """Closed, one handle (Euler number 0); vertices on the torus around the z axis."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = 2 * np.pi * u / around, 2 * np.pi * v / across
    ring = major + minor * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), minor * np.sin(b)], axis=-1).reshape(-1, 3)

    def index(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return (i % around * across + j % across).ravel()

    corners = [index(u, v), index(u + 1, v), index(u + 1, v + 1), index(u, v + 1)]
    faces = np.concatenate([np.stack([corners[i] for i in triangle], axis=1) for triangle in ((0, 1, 2), (0, 2, 3))])
    return TriangleMesh(vertices, faces, name="torus")


def l_profile() -> TriangleMesh:
    """Closed, sharp and not convex: an L of two unit squares and their corner, one high; volume 3."""
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], np.float64)
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, np.ones(n)]])
    cap = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]])
    walls = [[(i, (i + 1) % n, n + (i + 1) % n), (i, n + (i + 1) % n, n + i)] for i in range(n)]
    faces = np.concatenate([cap[:, ::-1], cap + n, np.array(walls).reshape(-1, 3)])
    return TriangleMesh(vertices, faces, name="l_profile")


def two_boxes_touching_at_a_vertex() -> TriangleMesh:
    """Closed and watertight, but at the shared vertex the faces form two fans: not manifold."""
    return join(box(), box((1, 1, 1), (2, 2, 2)))


def overlapping_spheres() -> TriangleMesh:
    """Closed; two unit spheres whose centers are 1.0 apart, with no vertex in common: winding number 2 between them."""
    return join(moved(icosphere(), (-0.5, 0, 0)), moved(icosphere(), (0.45, 0.3, 0.1)))


def open_shell(count: int = 12) -> TriangleMesh:
    """Open; the graph of z = (x^2 - y^2) / 2 over [-1, 1]^2, wound upwards, 2 count^2 faces."""
    line = np.linspace(-1, 1, count + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x, y, (x * x - y * y) / 2], axis=-1).reshape(-1, 3)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    a, b, c, d = ((i + di) * (count + 1) + j + dj for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriangleMesh(vertices, faces, name="open_shell")


def holed_sphere(missing: int = 5) -> TriangleMesh:
    """Open; an icosphere of 320 faces without its first ``missing`` ones."""
    sphere = icosphere()
    return TriangleMesh(sphere.vertices, sphere.faces[missing:], name="holed_sphere")


def spherical_cap(share: float, around: int = 48, across: int = 24) -> TriangleMesh:
    """Open; the unit sphere from its pole at +z down to the angle ``share * pi``: a half for 0.5."""
    polar, angle = np.linspace(0, np.pi * share, across + 1)[1:], 2 * np.pi * np.arange(around) / around
    rings = [
        np.stack([np.sin(t) * np.cos(angle), np.sin(t) * np.sin(angle), np.full(around, np.cos(t))], axis=1)
        for t in polar
    ]
    i, j = np.arange(around), (np.arange(around) + 1) % around
    faces = [np.stack([np.zeros(around, int), 1 + i, 1 + j], axis=1)]
    for ring in range(1, across):
        above, below = 1 + (ring - 1) * around, 1 + ring * around
        faces += [np.stack([above + i, below + i, above + j], 1), np.stack([above + j, below + i, below + j], 1)]
    return TriangleMesh(np.concatenate([[[0, 0, 1]], *rings]), np.concatenate(faces), name=f"cap_{share:g}")


def box_without_a_lid() -> TriangleMesh:
    """Open; a box without its two faces at the top."""
    heights = box().vertices[_BOX_FACES][:, :, 2]
    return TriangleMesh(box().vertices, _BOX_FACES[(heights < 1).any(axis=1)], name="box_without_a_lid")


def open_cylinder(around: int = 48) -> TriangleMesh:
    """Open at both ends; radius 1, 3 high."""
    angle = 2 * np.pi * np.arange(around) / around
    rings = [np.stack([np.cos(angle), np.sin(angle), np.full(around, z)], axis=1) for z in (-1.5, 1.5)]
    i, j = np.arange(around), (np.arange(around) + 1) % around
    faces = np.concatenate([np.stack([i, j, i + around], axis=1), np.stack([j, j + around, i + around], axis=1)])
    return TriangleMesh(np.concatenate(rings), faces, name="open_cylinder")


def sheet(count: int = 6) -> TriangleMesh:
    """Open; the square [-1, 1]^2 at z = 0, wound upwards."""
    return TriangleMesh(open_shell(count).vertices * [1, 1, 0], open_shell(count).faces, name="sheet")


def crossing_sheets() -> TriangleMesh:
    """Open; two squares that cross in the y axis."""
    across = TriangleMesh(sheet().vertices[:, [2, 1, 0]], sheet().faces)
    both = join(sheet(), across)
    return TriangleMesh(both.vertices, both.faces, name="crossing_sheets")


def sliver_fan(count: int = 64, height: float = 1e-5) -> TriangleMesh:
    """Open; ``count`` slivers from one apex along a unit edge, ``height`` wide in all."""
    ends = np.c_[np.ones(count + 1), np.linspace(0, height, count + 1), np.zeros(count + 1)]
    rows = np.arange(1, count + 1)
    faces = np.stack([np.zeros(count, int), rows, rows + 1], axis=1)
    return TriangleMesh(np.concatenate([np.zeros((1, 3)), ends]), faces, name="sliver_fan")


def duplicate_faces() -> TriangleMesh:
    """A box with its first three faces a second time (one of them rolled, one reversed)."""
    extra = np.array([_BOX_FACES[0], np.roll(_BOX_FACES[1], 1), _BOX_FACES[2][::-1]])
    return TriangleMesh(box().vertices, np.concatenate([_BOX_FACES, extra]), name="duplicate_faces")


def flipped_faces(every: int = 7) -> TriangleMesh:
    """Closed; an icosphere with every ``every``-th face wound the wrong way."""
    sphere = icosphere()
    faces = sphere.faces.copy()
    faces[::every] = faces[::every, ::-1]
    return TriangleMesh(sphere.vertices, faces, name="flipped_faces")


def zero_area_triangles() -> TriangleMesh:
    """A box and two triangles of three different corners on one line (diagonals of the box)."""
    vertices = np.concatenate([box().vertices, [[0.5, 0.5, 0.0], [0.5, 0.5, 1.0]]])
    return TriangleMesh(vertices, np.concatenate([_BOX_FACES, [[0, 8, 3], [4, 9, 7]]]), name="zero_area_triangles")


def collapsed_faces() -> TriangleMesh:
    """A box and three triangles that use a vertex twice or three times: the surface is still that of the box."""
    faces = np.concatenate([_BOX_FACES, [[0, 0, 1], [2, 3, 2], [5, 5, 5]]])
    return TriangleMesh(box().vertices, faces, name="collapsed_faces")


def three_on_an_edge() -> TriangleMesh:
    """Three triangles on one edge: the smallest non-manifold mesh."""
    vertices = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    return TriangleMesh(vertices, [[0, 1, 2], [0, 1, 3], [0, 1, 4]], name="three_on_an_edge")


def bowtie() -> TriangleMesh:
    """Two triangles that share a single vertex: its faces form two fans."""
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]]
    return TriangleMesh(vertices, [[0, 1, 2], [0, 3, 4]], name="bowtie")


def unreferenced_vertices() -> TriangleMesh:
    """A box with two vertices that no face uses, one of them far outside."""
    vertices = np.concatenate([box().vertices, [[0.5, 0.5, 0.5], [100.0, 0.0, 0.0]]])
    return TriangleMesh(vertices, _BOX_FACES, name="unreferenced_vertices")


def soup(mesh: TriangleMesh) -> TriangleMesh:
    """The same triangles with three vertices of their own each, as in an .stl file."""
    faces = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    return TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), faces, name=f"{mesh.name}_soup")


def moved(mesh: TriangleMesh, offset: tuple[float, float, float]) -> TriangleMesh:
    return TriangleMesh(mesh.vertices + np.asarray(offset, np.float64), mesh.faces, name=mesh.name, parts=mesh.parts)


def scaled(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    """``factor`` < 0 mirrors the mesh and leaves it inside out."""
    return TriangleMesh(mesh.vertices * factor, mesh.faces, name=mesh.name, parts=mesh.parts)


def turned(mesh: TriangleMesh, seed: int) -> TriangleMesh:
    """A copy in a random pose, up to 10 along each axis from where it was: its edges lie anywhere among voxels."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[0] *= np.sign(np.linalg.det(turn))
    return TriangleMesh(mesh.vertices @ turn.T + rng.uniform(-10.0, 10.0, 3), mesh.faces, name=mesh.name)


def far_away(mesh: TriangleMesh, distance: float = 1e6) -> TriangleMesh:
    """A copy ``distance`` from the origin, along no axis."""
    return moved(mesh, tuple(distance * np.array([2.0, -1.0, 2.0]) / 3.0))


def join(*meshes: TriangleMesh) -> TriangleMesh:
    """The meshes side by side, each a part."""
    vertices, faces, parts = [], [], []
    vertex_count = face_count = 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + vertex_count)
        parts.append(MeshPart(mesh.name, face_count, len(mesh.faces)))
        vertex_count += len(mesh.vertices)
        face_count += len(mesh.faces)
    name = "_".join(dict.fromkeys(mesh.name for mesh in meshes))
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces), name=name, parts=tuple(parts))


# Watertight and oriented outwards.
CLOSED: tuple[Callable[[], TriangleMesh], ...] = (
    tetrahedron,
    box,
    nested_boxes,
    icosphere,
    torus,
    l_profile,
    two_boxes_touching_at_a_vertex,
    overlapping_spheres,
)
OPEN: tuple[Callable[[], TriangleMesh], ...] = (single_triangle, open_shell, holed_sphere, sliver_fan, bowtie)
# Meshes with a defect that files in the field have.
DEFECTIVE: tuple[Callable[[], TriangleMesh], ...] = (
    inside_out_box,
    duplicate_faces,
    flipped_faces,
    zero_area_triangles,
    collapsed_faces,
    three_on_an_edge,
    unreferenced_vertices,
)


def cone(around: int, height: float) -> TriangleMesh:
    """Closed; a regular polygon of circumradius 1 around the origin and an apex above it: needles if there are many."""
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1)
    i, apex, middle = np.arange(around), np.full(around, around), np.full(around, around + 1)
    j = (i + 1) % around
    faces = np.concatenate([np.stack([i, j, apex], axis=1), np.stack([j, i, middle], axis=1)])
    return TriangleMesh(np.concatenate([ring, [[0, 0, height], [0, 0, 0]]]), faces, name=f"cone_{around}_{height:g}")


# What files in the field have done to a good mesh, for queries that must bear it. Seeded: the same mesh every time.


def with_holes(mesh: TriangleMesh, share: float, seed: int = 71) -> TriangleMesh:
    """Without this share of its faces, here and there."""
    keep = np.random.default_rng(seed).random(len(mesh.faces)) >= share
    return TriangleMesh(mesh.vertices, mesh.faces[keep], name=f"{mesh.name}_holes")


def with_large_hole(mesh: TriangleMesh, share: float = 0.15, seed: int = 72) -> TriangleMesh:
    """Without this share of its faces, all around one of them."""
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    middle = centers[np.random.default_rng(seed).integers(len(centers))]
    distance = np.linalg.norm(centers - middle, axis=1)
    keep = distance > np.quantile(distance, share)
    return TriangleMesh(mesh.vertices, mesh.faces[keep], name=f"{mesh.name}_large_hole")


def with_flips(mesh: TriangleMesh, share: float = 0.05, seed: int = 73) -> TriangleMesh:
    """This share of its faces wound the other way."""
    flipped = np.random.default_rng(seed).random(len(mesh.faces)) < share
    faces = np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces)
    return TriangleMesh(mesh.vertices, faces, name=f"{mesh.name}_flips")


def with_duplicates(mesh: TriangleMesh, share: float = 0.05, seed: int = 74) -> TriangleMesh:
    """This share of its faces a second time."""
    twice = np.random.default_rng(seed).random(len(mesh.faces)) < share
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[twice]]), name=f"{mesh.name}_duplicates")


def doubled(mesh: TriangleMesh, faces: slice = slice(None)) -> TriangleMesh:
    """These faces a second time, wound the other way: both sides of a surface, as some programs write them."""
    both = np.concatenate([mesh.faces, mesh.faces[faces, ::-1]])
    return TriangleMesh(mesh.vertices, both, name=f"{mesh.name}_doubled")


def with_fins(mesh: TriangleMesh, share: float = 0.05, seed: int = 75) -> TriangleMesh:
    """A triangle that stands out from an edge of each of this share of its faces, up to 2% of the diagonal high."""
    rng = np.random.default_rng(seed)
    chosen = mesh.faces[rng.random(len(mesh.faces)) < share]
    a, b, c = (mesh.vertices[chosen[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tips = (a + b) / 2 + normal * (0.02 * mesh.diagonal * rng.random((len(chosen), 1)))
    fins = np.stack([chosen[:, 0], chosen[:, 1], len(mesh.vertices) + np.arange(len(chosen))], axis=1)
    vertices = np.concatenate([mesh.vertices, tips])
    return TriangleMesh(vertices, np.concatenate([mesh.faces, fins]), name=f"{mesh.name}_fins")


def overlapping_copies(mesh: TriangleMesh, count: int = 3, seed: int = 76) -> TriangleMesh:
    """Copies of it, each moved by a tenth of its diagonal or so: winding number 3 where they all overlap."""
    rng = np.random.default_rng(seed)
    copies = [moved(mesh, tuple(rng.normal(0, 0.1 * mesh.diagonal, 3))) for _ in range(count - 1)]
    return join(mesh, *copies)


def inside_out(mesh: TriangleMesh) -> TriangleMesh:
    """All faces wound the other way."""
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1], name=f"{mesh.name}_inside_out")


def half_shell(mesh: TriangleMesh) -> TriangleMesh:
    """Its faces above the median height along y: an open bowl."""
    height = mesh.vertices[mesh.faces].mean(axis=1)[:, 1]
    return TriangleMesh(mesh.vertices, mesh.faces[height > np.median(height)], name=f"{mesh.name}_half_shell")


BROKEN: dict[str, Callable[[TriangleMesh], TriangleMesh]] = {
    "1% holes": lambda mesh: with_holes(mesh, 0.01),
    "10% holes": lambda mesh: with_holes(mesh, 0.1),
    "one large hole": with_large_hole,
    "5% flips": with_flips,
    "duplicates": with_duplicates,
    "fins": with_fins,
    "overlapping copies": overlapping_copies,
    "inside-out": inside_out,
    "open shell": half_shell,
}
