"""Contacts of two surfaces, one of which may have been moved: where they touch, are near or cross."""

from __future__ import annotations

import math
from collections import namedtuple
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.snapshot import snapshot
from geokit.core.gradients.rules import untracked
from geokit.core.memory import available_memory
from geokit.core.poses.move import require_rigid
from geokit.core.query.ask import query
from geokit.core.require import require_number
from geokit.errors import InputError
from geokit.mesh.queries.distance import DistanceQueries
from geokit.mesh.queries.overlaps import LEAF_GRAIN, require_surface
from geokit.mesh.sign.queries import SignQueries
from geokit.mesh.topology.connectivity import connected_components
from geokit.mesh.topology.normals import face_normals, unit

if TYPE_CHECKING:
    Floats = NDArray[np.float64]
    Indices = NDArray[np.int64]

# Vertices in all poses that are placed at a time, and pairs for which there is room at first.
PLACED, PAIRS = 1 << 22, 1 << 20
# Share of the size within which distances are known, as in distance_kernels.
CONTACT_ERROR = 1e-12
# Share of a face that a point is away from its edges, if it is not on one.
ON_EDGE = 1e-9


class Contacts(NamedTuple):
    """Contacts of two surfaces in B poses, ordered by pose, then the deepest first, then by face.

    Attributes:
        offsets: Pose i has the contacts ``offsets[i]:offsets[i + 1]``; shape (B + 1,) int64, B = 1 for one pose.
        points: Of each contact the nearest point on this surface, or the deepest [world], shape (K, 3).
        points_other: That on the other surface [world], ``points + separations * normals`` to rounding, (K, 3).
        normals: From this surface to the other one, of length 1, shape (K, 3).
        separations: Distance of the two points [world], negative where one is inside the other body, shape (K,).
        depths: Bounds of the largest depth of a point of the contact, from below and from above [world], (K, 2).
        areas: Area of this surface from which the other one is within the margin, along the normal [world^2], (K,).
        faces: Triangles of ``points``, shape (K,) int32.
        faces_other: Triangles of ``points_other``, shape (K,) int32.
        penetrations: Bounds of the shortest translation that separates the two bodies [world], shape (B, 2).
    """

    offsets: NDArray[np.int64]
    points: NDArray[np.float64]
    points_other: NDArray[np.float64]
    normals: NDArray[np.float64]
    separations: NDArray[np.float64]
    depths: NDArray[np.float64]
    areas: NDArray[np.float64]
    faces: NDArray[np.int32]
    faces_other: NDArray[np.int32]
    penetrations: NDArray[np.float64]


# Points of a body that are inside of the other one. Of ``points``, (N, 2, 3), of body 0 and of body 1, one is the
# sample, the other one the nearest to it.
_Samples = namedtuple("_Samples", "pose place depth points faces")


class _Shape:
    """What contacts ask of a mesh: its distinct positions, faces beside and around what, lengths, normals."""

    def __init__(self, surface: Any) -> None:
        mesh, topology = surface.mesh, surface._topology
        edges, kept = topology.edges, np.flatnonzero(~topology.collapsed)
        # Positions that no face uses are left out.
        used, corner = np.unique(topology.corners, return_inverse=True)
        self.corners, self.places = corner.reshape(-1, 3), np.empty((len(used), 3))
        self.places[corner.ravel()] = mesh.vertices[mesh.faces.ravel()]
        # The next face around each edge; at a border the face itself.
        following = np.arange(1, len(edges.order) + 1)
        following[edges.starts + edges.uses - 1] = edges.starts
        self.beside = np.tile(np.arange(mesh.face_count)[:, None], 3)
        self.beside[kept[edges.order // 3], edges.order % 3] = kept[edges.order[following] // 3]
        by_place = np.argsort(self.corners.ravel(), kind="stable")
        self.around = by_place // 3
        self.starts = np.searchsorted(self.corners.ravel()[by_place], np.arange(len(self.places) + 1))
        ends = self.places[self.corners]
        sides = np.roll(ends, -1, axis=1) - ends
        # No point of a face is farther than this from all of its corners.
        self.reach = np.linalg.norm(sides, axis=2).max(axis=1) / math.sqrt(3.0)
        self.normals = face_normals(mesh) * surface._outward[:, None]

    def faces_around(self, place: Indices) -> tuple[Indices, Indices]:
        """The rows of ``place``, each as often as it has faces, and these faces."""
        begin, count = self.starts[place], self.starts[place + 1] - self.starts[place]
        row = np.repeat(np.arange(len(place)), count)
        return row, self.around[np.arange(len(row)) + (begin - np.cumsum(count) + count)[row]]


class ContactQueries(SignQueries, DistanceQueries):
    """Contacts of a :class:`geokit.mesh.Surface` with others."""

    _shape = cached_property(_Shape)

    @query(memory=lambda self, other, **_: 450 * (self.mesh.face_count + other.mesh.face_count))
    def contacts(self, other: DistanceQueries, *, transform: ArrayLike | None = None, margin: float = 0.0) -> Contacts:
        """Contacts with another surface: of each region where the two touch, are near or cross the points on both.

        A contact is a connected part of the pairs of points, one on each surface, that are no farther apart than the
        margin, found in faces, with what is inside of a closed body between them. So four legs on one face are four
        contacts, and a body that another one has swallowed is one.

        None is missed: whether faces touch is decided exactly for corners that were moved and rounded to float64, and
        distances are exact to 1e-12 of the size of the two. ``depths`` and ``penetrations`` are bounds that hold to
        1e-11 of the size, or by as much as the pose is off a rigid one; depths from below are those of vertices, and of
        a point on each face that crosses. Inside is as :meth:`signed_distance` says; only closed bodies have one.

        Args:
            other: A surface on the same device; a level set as that of :func:`geokit.mesh.from_volume`.
            transform: Where this surface is: a rigid map or mirror for column vectors, (4, 4), or many, (B, 4, 4).
            margin: Distance up to which surfaces are near [world]; 0 takes those that touch or cross.
        Returns:
            Contacts, arrays of NumPy: ``offsets`` (B + 1,) and fields of K contacts.
        Raises:
            InputError: As :meth:`distance`; the transform is not rigid (to 1e-6); margin is negative or not finite.
            DeviceMemoryError: There are more pairs of faces than the device can hold.
        Example:
            >>> ball = gk.mesh.Surface(gk.mesh.sphere(radius=1.0), device="cpu")
            >>> floor = gk.mesh.Surface(gk.mesh.box(size=(8, 8, 1), center=(0, 0, -0.5)), device="cpu")
            >>> poses = np.tile(np.eye(4), (2, 1, 1))
            >>> poses[:, 2, 3] = [1.25, 0.75]
            >>> found = ball.contacts(floor, transform=poses, margin=0.3)
            >>> found.separations.round(9), found.normals[0].round(9)
            (array([ 0.25, -0.25]), array([ 0.,  0., -1.]))
            >>> found.penetrations[1].round(9)
            array([0.25, 0.25])
        """
        margin, other = require_number(margin, "margin"), snapshot(require_surface(self, other))  # type: ignore[assignment]
        if not 0.0 <= margin < math.inf:
            raise InputError(f"margin: {margin} is not a distance; give a finite number from 0 up")
        maps = (np.eye(4) if transform is None else require_rigid(transform)).reshape(-1, 4, 4)
        count, *found = self._of_blocks(partial(self._within, margin), other, maps, transform is None)
        bodies = untracked(self), untracked(other)
        return _Regions(bodies, maps, np.repeat(np.arange(len(maps)), count), *found).answer()

    def _within(self, margin: float, other: Any, maps: Floats, scale: Floats) -> tuple[NDArray[Any], ...]:
        """The number of pairs within the margin in each pose; their faces, distances, areas and points, by faces."""
        from geokit.mesh.queries.distance_kernels import list_within_kernel

        device, leaves = self._device, self._leaf_count
        poses = [self._on_device(maps[:, :3, :3], wp.mat33d), self._on_device(maps[:, :3, 3], wp.vec3d)]
        given = [self._on_device(scale, wp.float64), wp.float64(margin)]
        inputs = [leaves, self._tree, *poses, other._tree, other._slot_boxes, *given]
        room, count = 0, max(min(PAIRS, 8 * leaves * len(maps)), 1)
        # What there is no room for is counted, and found a second time.
        while count > room:
            room, total = count, wp.zeros(1, dtype=wp.int64, device=device)
            available_memory.require_room(76 * room, f"{room} pairs need", "ask for fewer at once", device)
            out = [wp.empty(n * room, dtype=kind, device=device) for n, kind in ((3, wp.int32), (8, wp.float64))]
            launcher.launch(list_within_kernel, leaves * len(maps), inputs, [total, *out], device, grain=LEAF_GRAIN)
            count = int(total.numpy()[0])
        pairs, rows = out[0].numpy().reshape(-1, 3)[:count], out[1].numpy().reshape(-1, 8)[:count]
        order = np.lexsort(pairs.T[::-1])
        in_pose, rows = np.bincount(pairs[:, 0], minlength=len(maps)), rows[order]
        return in_pose, pairs[order, 1:], rows[:, 0], rows[:, 1], rows[:, 2:].reshape(-1, 2, 3)


class _Regions:
    """Contacts made of pairs of faces, and of what is inside. Body 0 is that which the maps move, body 1 the other."""

    def __init__(self, bodies: Any, maps: Floats, pose: Any, faces: Any, distance: Any, area: Any, points: Any) -> None:
        self.bodies, self.maps = bodies, maps
        self.back = np.linalg.inv(maps).astype(np.float64)
        self.pose, self.faces, self.distance, self.area, self.points = pose, faces, distance, area, points
        self.shapes = [body._shape for body in bodies]
        far = max(np.abs(bodies[1].bounds).max(), np.abs(maps[:, :3, 3]).max(initial=0.0))
        # Nothing is inside by less.
        self.error = CONTACT_ERROR * max(body._frame.scale for body in bodies) + 4e-15 * far
        self.inner = [self._inner_places(k) for k in (0, 1)]
        poses = np.concatenate([pose, *(one.pose for one in self.inner)])
        label = connected_components(len(poses), *self._links())
        _, first, region = np.unique(label, return_index=True, return_inverse=True)
        self.pose_of = poses[first]
        self.region, *self.inner_region = np.split(region, np.cumsum([len(pose), len(self.inner[0].pose)]))

    def answer(self) -> Contacts:
        count, region, pose = len(self.pose_of), self.region, self.pose_of
        met = np.flatnonzero(self.distance == 0.0)
        own = [_turned(self.maps[self.pose], self.shapes[0].normals[self.faces[:, 0]])]
        own += [self.shapes[1].normals[self.faces[:, 1]]]
        points, faces = np.zeros((count, 2, 3)), np.zeros((count, 2), np.int32)
        separations, normals, depths = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 2))
        # The nearest pair; of those that touch the one whose faces are most opposed.
        facing = np.einsum("ij,ij->i", *own).round(9) * (self.distance == 0.0)
        has, best = _first_of(region, self.distance, facing)
        points[has], faces[has], separations[has] = self.points[best], self.faces[best], self.distance[best]
        normals[has] = self._normals_of(best, own[0][best], own[1][best])
        samples = []
        for k, (shape, inner) in enumerate(zip(self.shapes, self.inner, strict=True)):
            if not self.bodies[1 - k].is_closed:
                continue
            row, around = shape.faces_around(inner.place)
            np.maximum.at(depths[:, 1], self.inner_region[k][row], inner.depth[row] + shape.reach[around])
            np.maximum.at(depths[:, 1], region[met], shape.reach[self.faces[met, k]])
            # On each face that crosses, the mean of what it shares.
            key, at = np.unique(region[met] * len(shape.reach) + self.faces[met, k], return_inverse=True)
            middle, group = np.zeros((len(key), 3)), key // len(shape.reach)
            np.add.at(middle, at, self.points[met, k] / np.bincount(at)[at, None])
            found = self._sampled(k, pose[group], np.arange(len(key)), middle, key % len(shape.reach))
            samples += [(self.inner_region[k], *inner[2:]), (group[found.place], *found[2:])]
        if samples:
            of, depth, sampled, touched = (np.concatenate(each) for each in zip(*samples, strict=True))
            has, deepest = _first_of(of, -depth, *touched.T)
            depths[has, 0], points[has], faces[has] = depth[deepest], sampled[deepest], touched[deepest]
            separations[has], normals[has] = -depth[deepest], unit(points[has, 0] - points[has, 1])
        penetrations = self._penetrations(faces, normals, depths, pose[region[met]])
        depths[:, 1] = np.minimum(depths[:, 1] + self.error * (depths[:, 1] > 0.0), penetrations[pose, 1])
        areas = np.bincount(region, self.area, count).astype(np.float64)
        order = np.lexsort((*faces.T[::-1], separations, pose))
        offsets = np.searchsorted(pose[order], np.arange(len(self.maps) + 1))
        each = points[:, 0], points[:, 1], normals, separations, depths, areas, faces[:, 0], faces[:, 1]
        fields: list[Any] = [offsets, *(np.ascontiguousarray(one[order]) for one in each), penetrations]
        return Contacts(*fields)

    def _inner_places(self, k: int) -> _Samples:
        """The positions of body k that are inside of the other one, by pose and place."""
        shape, other, to_other = self.shapes[k], self.bodies[1 - k], (self.maps, self.back)[k]
        step, found = max(PLACED // len(shape.places), 1), []
        for at in range(0, len(self.maps) if other.is_closed else 0, step):
            maps, (low, high) = to_other[at : at + step], other.bounds
            placed = maps[:, :3, :3] @ shape.places.T + (maps[:, :3, 3] - (low + high) / 2.0)[:, :, None]
            found.append((np.abs(placed) < (high - low)[:, None] / 2.0 + self.error).all(axis=1))
        pose, place = np.nonzero(np.concatenate([np.zeros((0, len(shape.places)), bool), *found]))
        points = shape.places[place] if k else _turned(self.maps[pose], shape.places[place]) + self.maps[pose, :3, 3]
        return self._sampled(k, pose, place, points, shape.around[shape.starts[place]])

    def _sampled(self, k: int, pose: Indices, place: Indices, points: Floats, faces: Indices) -> _Samples:
        """Those of the points of body k [world] that are inside of the other one; they lie on the faces."""
        seen = _turned(self.back[pose], points) + self.back[pose, :3, 3] if k else points
        found = self.bodies[1 - k].signed_distance(seen)
        foot = _turned(self.maps[pose], found.points) + self.maps[pose, :3, 3] if k else found.points
        is_in, turn = -found.distance > self.error, slice(None, None, -1 if k else 1)
        ends, touched = np.stack([points, foot][turn], axis=1), np.stack([faces, found.triangle_id][turn], axis=1)
        return _Samples(pose[is_in], place[is_in], -found.distance[is_in], ends[is_in], touched[is_in])

    def _links(self) -> tuple[Indices, Indices]:
        """Nodes that are of one contact: pairs whose faces are the same or neighbors, and inner places beside them."""
        faces, node, links = self.faces, np.arange(len(self.pose)), []
        counts = [len(shape.corners) for shape in self.shapes]
        # The pairs are in order of pose, face and face of the other body.
        seen, rank = np.unique(self.pose * counts[0] + faces[:, 0], return_inverse=True)
        keys = rank * counts[1] + faces[:, 1]
        for j in range(3):
            beside = _places(seen, self.pose * counts[0] + self.shapes[0].beside[faces[:, 0], j])
            links.append((node, _places(keys, np.where(beside < 0, -1, beside * counts[1] + faces[:, 1]))))
            links.append((node, _places(keys, rank * counts[1] + self.shapes[1].beside[faces[:, 1], j])))
        start = len(node)
        for k, (shape, inner) in enumerate(zip(self.shapes, self.inner, strict=True)):
            keys = inner.pose * len(shape.places) + inner.place
            row, around = shape.faces_around(inner.place)
            for owner, of, face in ((node, self.pose, faces[:, k]), (start + row, inner.pose[row], around)):
                for j in range(3):
                    at = _places(keys, of * len(shape.places) + shape.corners[face, j])
                    links.append((owner, np.where(at < 0, -1, at + start)))
            start += len(keys)
        one, other = (np.concatenate(ends) for ends in zip(*links, strict=True))
        return one[other >= 0], other[other >= 0]

    def _normals_of(self, rows: Indices, of_0: Floats, of_1: Floats) -> Floats:
        """Normals of pairs of faces, from body 0 to body 1; those of their faces are given."""
        maps, points, inside = self.maps[self.pose[rows]], self.points[rows], []
        for k, shape in enumerate(self.shapes):
            ends = shape.places[shape.corners[self.faces[rows, k]]]
            if k == 0:
                ends = ends @ maps[:, :3, :3].transpose(0, 2, 1) + maps[:, None, :3, 3]
            away = ends - points[:, k, None]
            weight = np.linalg.norm(np.cross(np.roll(away, -1, axis=1), np.roll(away, -2, axis=1)), axis=2)
            inside.append(weight.min(axis=1) > ON_EDGE * weight.sum(axis=1))
        between = of_0 - of_1
        choices = [self.distance[rows] > self.error, inside[1], inside[0], np.abs(between).max(axis=1) > ON_EDGE]
        normals = [points[:, 1] - points[:, 0], -of_1, of_0, between]
        return unit(np.select([choice[:, None] for choice in choices], normals, [0.0, 0.0, 1.0]))

    def _penetrations(self, faces: Any, normals: Floats, depths: Floats, met: Indices) -> Floats:
        """Bounds of the least translation that separates the bodies in each pose."""
        found, pose = np.zeros((len(self.maps), 2)), self.pose_of
        np.maximum.at(found[:, 0], pose, depths[:, 0])
        met = np.union1d(met, np.flatnonzero(found[:, 0]))
        found[met, 1] = np.inf
        own = _turned(self.maps[pose], self.shapes[0].normals[faces[:, 0]]), -self.shapes[1].normals[faces[:, 1]]
        along = np.concatenate([normals, *own, np.tile([*np.eye(3), *-np.eye(3)], (len(met), 1))])
        of = np.concatenate([pose, pose, pose, np.repeat(met, 6)])
        used = (found[of, 1] > 0.0) & along.any(axis=1)
        along, of = along[used], of[used]
        shadow = _furthest(self.shapes[0].places, _turned(self.maps[of].swapaxes(1, 2), along))
        shadow += _furthest(self.shapes[1].places, -along) + np.einsum("ij,ij->i", along, self.maps[of, :3, 3])
        np.minimum.at(found[:, 1], of, shadow)
        found[met, 1] = np.maximum(found[met, 1], 0.0) + self.error
        return found


def _turned(maps: Floats, rows: Floats) -> Floats:
    """Each row as a direction, turned by its map."""
    return np.einsum("nij,nj->ni", maps[:, :3, :3], rows)


def _places(keys: Indices, wanted: Indices) -> Indices:
    """Where each wanted number stands in sorted keys, -1 if nowhere."""
    at = np.searchsorted(keys, wanted)
    return np.where(np.append(keys, -2)[at] == wanted, at, -1)


def _first_of(group: Indices, *keys: NDArray[Any]) -> tuple[Indices, Indices]:
    """The groups that there are, and the row of each that is first by the keys."""
    order = np.lexsort((*keys[::-1], group))
    found, at = np.unique(group[order], return_index=True)
    return found, order[at]


def _furthest(places: Floats, directions: Floats) -> Floats:
    """How far along each direction there are places."""
    step = max(PLACED // len(places), 1)
    parts = [(directions[at : at + step] @ places.T).max(axis=1) for at in range(0, len(directions), step)]
    return np.concatenate([np.zeros(0), *parts])
