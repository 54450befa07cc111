"""Sweeps of level sets of meshes and of isosurfaces: thin walls, small bodies, far positions, the end of the band."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.stability import shapes
from geokit.accuracy.stability.fields import MIDDLE, ball, joined, level_set, unit_vectors
from geokit.accuracy.trials.model import Judgement, Sweeps
from geokit.accuracy.trials.running import without_warnings

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

SWEEPS = Sweeps()
Floats = NDArray[np.float64]

# Half the side of a wall [voxels], and the extent of its queries: farther from the rim than the wall is thick.
WALL_HALF, WALL_ASKED = 8.0, 4.0
# Share of half the thickness that queries keep from the faces: closer, rounding determines the sign.
WALL_SKIN = 0.1
# Number of walls of each thickness.
WALLS = 3
# float32 stores distances of a band of half width 3 to half of 2^-22.
ROUNDING = 1e-6
# Radius of the sphere whose isovalues leave the band [voxels].
BAND_RADIUS = 20.0
# Voxels across the moved torus, and the distance of checked voxels from random vertices [voxels].
FAR_VOXELS, FAR_REACH = 40.0, 2
# Direction without a simple ratio of components, so that no coordinate stays exact.
FAR_DIRECTION = np.array([0.6, -0.5, 0.62])


@SWEEPS.add(
    "volume.from_mesh",
    "voxels",
    "from_mesh_thin_wall",
    "thickness of a wall [voxels]",
    (4.0, 3.0, 2.0, 1.0, 0.5, 0.25, 0.1),
    last=2.0,
    error=0.5 + ROUNDING,
    statement="Points inside walls of 2 voxels and more have the right sign; the interpolated distance is off by "
    "up to half a voxel around the middle of any wall, and walls thinner than a voxel may have no inside.",
)
@joined
def wall_distances(thickness: float, *, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Signed distances at points inside walls, sampled from their level set at order 1."""
    for number in range(WALLS):
        mesh, turn, middle = _wall(thickness, seed, number)
        random = np.random.default_rng([seed, number])
        across = (1.0 - WALL_SKIN) * 0.5 * thickness * random.uniform(-1.0, 1.0, 300)
        along = random.uniform(-WALL_ASKED, WALL_ASKED, (300, 2))
        points = np.column_stack([along, across]) @ turn.T + middle
        found = _level_set_of(mesh, device).sample(points, device=device)
        yield Judgement(np.abs(found - (np.abs(across) - 0.5 * thickness)), np.asarray(found >= 0.0), points)


@SWEEPS.add(
    "mesh.from_volume",
    "voxels",
    "from_volume_thin_wall",
    "thickness of a wall [voxels]",
    (4.0, 3.0, 2.0, 1.0, 0.5, 0.25, 0.1),
    last=2.0,
    error=0.1,
    statement="Both faces of walls of 2 voxels and more are recovered to 0.1 voxel; walls of 1 voxel and less are "
    "off by half a voxel and more, have holes, or are lost.",
)
@joined
def wall_surfaces(thickness: float, *, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Distances of points on both faces of a wall from the reconstructed surface."""
    from geokit.mesh.volumes.from_volume import from_volume

    for number in range(WALLS):
        mesh, turn, middle = _wall(thickness, seed, number)
        random = np.random.default_rng([seed, number])
        across = 0.5 * thickness * np.where(np.arange(40) % 2, 1.0, -1.0)
        points = np.column_stack([random.uniform(-WALL_ASKED, WALL_ASKED, (40, 2)), across]) @ turn.T + middle
        found = from_volume(_level_set_of(mesh, device), device=device)
        yield Judgement(_distances_from(found, points), np.full(40, len(found.faces) == 0), points)


@SWEEPS.add(
    "mesh.from_volume",
    "voxels",
    "from_volume_isovalue",
    "distance of the isovalue from the surface [voxels], band of half width 3",
    (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 2.9, 3.0, 3.5),
    last=2.0,
    error=0.06,
    statement="Isovalues up to half_width - 1 voxels from the surface give the offset surface, to 0.06 voxel on a "
    "sphere of 20 voxels; closer to the end of the band the surface is up to a voxel off, and beyond it there is "
    "none.",
    logarithmic=False,
)
@joined
def offset_surfaces(isovalue: float, *, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Distances of the isosurfaces inside and outside of a sphere from the exact spheres."""
    from geokit.mesh.volumes.from_volume import from_volume

    band = level_set(ball(BAND_RADIUS), BAND_RADIUS)
    for signed in (isovalue, -isovalue):
        found = from_volume(band, isovalue=signed, device=device)
        yield _judged_sphere(found, MIDDLE, BAND_RADIUS + signed, seed, backwards=0)


# By method, error times radius [voxels^2]. A triangle has edges of up to sqrt(3) voxels and sags by 3/8 below a sphere
# through its corners; corners are off by another 1/8 (marching cubes) to 3/8. Measured 0.73, 0.52 and 0.67; the promise
# is twice that.
@SWEEPS.add(
    "mesh.from_volume, {method}",
    "voxels",
    "from_volume_{method}_curvature",
    "radius of curvature [voxels]",
    (16.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    cases=[
        {"method": method, "constant": constant, "error": partial(operator.truediv, constant)}
        for method, constant in (("surface_nets", 1.5), ("marching_cubes", 1.0), ("dual_contouring", 1.5))
    ],
    last=1.0,
    statement="The surface of a distance field is off by at most {constant:g} voxel^2 over the radius of curvature, "
    "down to a radius of 1 voxel; balls of less than 0.87 voxel may be lost.",
)
@joined
def ball_surfaces(radius: float, *, method: str, seed: int = 0, device: Any = None) -> Iterator[Judgement]:
    """Distances between balls and their reconstructed surfaces, in both directions."""
    from geokit.mesh.volumes.from_volume import from_volume

    # Balls centered on a cell are the first to contain no voxel.
    centers = [np.full(3, 0.5), *np.random.default_rng(seed).random((3, 3))]
    for center in centers:
        body = level_set(ball(radius, center), radius)
        found = from_volume(body, method=method, device=device)
        yield _judged_sphere(found, center, radius, seed, backwards=30)


@SWEEPS.add(
    "volume.from_mesh",
    "sizes",
    "from_mesh_origin",
    "distance from the origin [sizes of the mesh]",
    (1.0, 1e3, 1e6, 1e9, 1e12, 1e14, 1e15),
    last=1e9,
    error=1e-6,
    statement="Distances have an error of at most 1e-6 of the size up to 1e9 sizes from the origin: a few "
    "roundings of float64 coordinates, 2^-52 of the distance from the origin, and nothing else.",
)
def far_distances(distance: float, *, seed: int = 0, device: Any = None) -> Judgement:
    """Voxels near the surface of a far torus, against the same torus moved back without rounding."""
    near = shapes.torus(24, 12)
    size = float(np.linalg.norm(near.vertices.max(axis=0) - near.vertices.min(axis=0)))
    offset = distance * size * FAR_DIRECTION
    mesh = shapes.moved(near, offset)
    random = np.random.default_rng(seed)
    voxel_size = size / FAR_VOXELS
    grid = _level_set_of(mesh, device, voxel_size)
    chosen = mesh.vertices[random.integers(0, len(mesh.vertices), 300)]
    start = grid.info.transform[:3, 3]
    index = np.rint((chosen - start) / voxel_size) + random.integers(-FAR_REACH, FAR_REACH + 1, (300, 3))
    points = index * voxel_size + start
    found = grid.sample(points, order=0, device=device)
    # Differences of close numbers are exact.
    true = reference.signed_distance(mesh.vertices - offset, mesh.faces, points - offset)
    true = np.clip(true, -grid.info.background, grid.info.background)
    return Judgement(np.abs(found - true) / size, np.zeros(300, bool), points)


def _wall(thickness: float, seed: int, number: int) -> tuple[TriangleMesh, Floats, Floats]:
    """A wall, its rotation and its center; the first wall is axis-aligned and halfway between two voxels."""
    turn = shapes.rotation(4 * seed + number) if number else np.eye(3)
    middle = np.random.default_rng([seed, number, 1]).random(3) if number else np.array([0.2, 0.3, 0.5])
    half = (WALL_HALF, WALL_HALF, 0.5 * thickness)
    plate = shapes.box((-half[0], -half[1], -half[2]), half)
    from geokit.mesh.model.triangle_mesh import TriangleMesh

    return TriangleMesh(plate.vertices @ turn.T + middle, plate.faces, name="wall"), turn, middle


def _level_set_of(mesh: TriangleMesh, device: Any, voxel_size: float = 1.0) -> SparseVolume:
    from geokit.volume.distance_fields.from_mesh import from_mesh

    # Warnings about lost components are expected: the sweep measures their loss.
    found: SparseVolume = without_warnings(lambda: from_mesh(mesh, voxel_size, device=device))
    return found


def _distances_from(mesh: TriangleMesh, points: Floats) -> Floats:
    if not len(mesh.faces):
        return np.zeros(len(points))
    return reference.closest_point(mesh.vertices, mesh.faces, points).distance


def _judged_sphere(mesh: TriangleMesh, center: Floats, radius: float, seed: int, backwards: int) -> Judgement:
    """The mesh's vertices and a point of each face against a sphere, and some points of the sphere against the mesh."""
    if not len(mesh.faces):
        return Judgement(np.zeros(1), np.ones(1, bool), center[None])
    weights = np.random.default_rng(seed).dirichlet([0.7] * 3, len(mesh.faces))
    on_faces = np.einsum("fk,fkc->fc", weights, mesh.vertices[mesh.faces])
    points = np.concatenate([mesh.vertices, on_faces])
    errors = np.abs(np.linalg.norm(points - center, axis=1) - radius)
    asked = center + radius * unit_vectors(backwards, seed)
    errors = np.concatenate([errors, _distances_from(mesh, asked)]) if backwards else errors
    return Judgement(errors, np.zeros(len(errors), bool), np.concatenate([points, asked]))
