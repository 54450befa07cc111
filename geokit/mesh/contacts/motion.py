"""How far a body moves before it touches another one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.poses.move import RIGID, require_rigid
from geokit.core.query.ask import query
from geokit.core.require import read_array, require_number
from geokit.errors import InputError
from geokit.mesh.contacts.contacts import CONTACT_ERROR, ContactQueries
from geokit.mesh.queries.distance import DistanceQueries
from geokit.mesh.queries.overlaps import require_surface
from geokit.mesh.topology.normals import unit

# Steps that a motion takes at most. Half as far each is usual; along a surface they are many.
STEPS = 1000


class TimeOfContact(NamedTuple):
    """How long a motion is free of contact; of several motions each is an array (B,).

    Attributes:
        time: No contact is earlier; from 0 to 1, the end of the motion.
        separation: Distance of the two surfaces then [world].
    """

    time: float | NDArray[np.float64]
    separation: float | NDArray[np.float64]


class MotionQueries(ContactQueries):
    """Motions of a :class:`geokit.mesh.Surface` up to a contact."""

    @query(memory=lambda self, *_, **__: 16 * self.mesh.face_count)
    def until_contact(
        self, other: DistanceQueries, *, motion: ArrayLike, tolerance: float | None = None
    ) -> TimeOfContact:
        """A time before which this surface does not touch the other one as it moves from one pose to another.

        The center of its box (``origin``) moves along a line while the body turns about it by less than half a turn,
        both evenly. Nothing tunnels, however thin or fast: no step is longer than the distance over a bound of the
        speed. The time is that at which the distance is first found within the tolerance, never later than the
        first touch but for 1e-12 of the size; it is earlier after 1000 steps, as along a wall, and 1 without contact.

        Args:
            other: A surface on the same device.
            motion: First and last pose, rigid maps for column vectors, (2, 4, 4), or of many motions, (B, 2, 4, 4).
            tolerance: Distance that counts as contact [world], more than 0; by default 1e-6 of this surface's size.
        Returns:
            TimeOfContact with time and separation, of many motions (B,).
        Raises:
            InputError: motion has another shape, is not rigid, or mirrors from one pose to the other; tolerance is not
                above 0 and finite; and as :meth:`distance`.
        Source:
            Mirtich, "Impulse-based Dynamic Simulation of Rigid Body Systems" (1996), conservative advancement. Differs:
            the bound is that of all directions, as bodies need not be convex.
        Example:
            >>> ball = gk.mesh.Surface(gk.mesh.sphere(radius=1.0), device="cpu")
            >>> wall = gk.mesh.Surface(gk.mesh.box(size=(0.001, 9, 9)), device="cpu")
            >>> path = np.stack([np.eye(4), np.eye(4)])
            >>> path[:, 0, 3] = [-11, 9]
            >>> round(ball.until_contact(wall, motion=path).time, 3)
            0.5
        """
        given: Any = read_array(motion, "motion", np.float64)
        if given.ndim not in (3, 4) or given.shape[-3:] != (2, 4, 4):
            raise InputError(f"motion: shape {given.shape} is not (2, 4, 4) or (B, 2, 4, 4); give two poses of each")
        path = require_rigid(given.reshape(-1, 4, 4)).reshape(-1, 2, 4, 4)
        near = 2e-6 * self._frame.scale if tolerance is None else require_number(tolerance, "tolerance")
        if not 0.0 < near < np.inf:
            raise InputError(f"tolerance: {tolerance} is not a distance; give a finite number above 0")
        first, last = path[:, 0, :3, :3], path[:, 1, :3, :3]
        if (mirrors := np.linalg.det(first) * np.linalg.det(last) < 0.0).any():
            raise InputError(f"motion: {int(mirrors.argmax())} turns into its mirror image; give two poses that do not")
        other = require_surface(self, other)  # type: ignore[assignment]
        axis, angle = _turn(first.transpose(0, 2, 1) @ last)
        center = path[..., :3, :3] @ self._frame.origin + path[..., :3, 3]
        along = center[:, 1] - center[:, 0]
        radius = self.furthest_point(self._frame.origin[None]).distance
        speed = (np.hypot.reduce(along, axis=1) + angle * radius) * (1.0 + 10.0 * RIGID)
        error = CONTACT_ERROR * (self._frame.scale + other._frame.scale) + 4e-15 * np.abs(center).max(initial=0.0)
        time, separation = np.zeros(len(path)), np.full(len(path), np.inf)
        moving = np.arange(len(path))
        for step in range(STEPS + 1):
            at = time[moving, None]
            poses = np.tile(np.eye(4), (len(moving), 1, 1))
            poses[:, :3, :3] = first[moving] @ _turned_by(axis[moving], angle[moving] * at[:, 0])
            poses[:, :3, 3] = center[moving, 0] + at * along[moving] - poses[:, :3, :3] @ self._frame.origin
            separation[moving] = self.distance(other, transform=poses).distance
            moving = moving[(separation[moving] > near) & (time[moving] < 1.0)]
            if not len(moving) or step == STEPS:
                break
            ahead = np.maximum(separation[moving] - error, 0.0)
            room = (1.0 - time[moving]) * speed[moving]
            time[moving] += np.where(ahead >= room, 1.0 - time[moving], ahead / np.maximum(speed[moving], ahead))
        if given.ndim == 3:
            return TimeOfContact(float(time[0]), float(separation[0]))
        return TimeOfContact(time, separation)


def _turn(linear: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis (B, 3) and angle (B,), up to half a turn, of rotations."""
    odd = np.stack(
        [linear[:, (k + 2) % 3, (k + 1) % 3] - linear[:, (k + 1) % 3, (k + 2) % 3] for k in range(3)], axis=1
    )
    cosine = np.trace(linear, axis1=1, axis2=2) - 1.0
    # Near half a turn the odd part vanishes; the even one has the axis then, but for its sign.
    fixed = np.linalg.eigh(linear + linear.transpose(0, 2, 1))[1][:, :, 2]
    fixed *= np.where(np.einsum("ij,ij->i", fixed, odd) < 0.0, -1.0, 1.0)[:, None]
    return np.where(cosine[:, None] < 0.0, fixed, unit(odd)), np.arctan2(np.linalg.norm(odd, axis=1), cosine)


def _turned_by(axis: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    return c * np.eye(3) + s * np.cross(np.eye(3), axis[:, None]) + (1.0 - c) * axis[:, :, None] * axis[:, None]
