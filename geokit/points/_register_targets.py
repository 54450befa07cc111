"""Registration targets: each returns a partner and a normal for every moved point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.base.snapshot import snapshot
from geokit.core.interop.objects import has_faces
from geokit.core.interop.user_arrays import LARGEST_MEASURED, read_vectors
from geokit.errors import InputError
from geokit.points.search.nearest import build_tree, nearest

if TYPE_CHECKING:
    import warp as wp

    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["Pairs", "Target", "make_target"]

# Number of neighbors for estimating a target's normals if none are given.
NORMAL_NEIGHBORS = 16
# Within a voxel of the band's edge, interpolation reads the constant background beyond it.
BAND_MARGIN = 1.0
# Points whose partners are nearer than this share of the second nearest are samples of the same places.
SAME_PLACES = 0.1


class Pairs(NamedTuple):
    """Partner, its normal, and a flag (1 or 0) for each moved point; entries without a partner are not set."""

    partner: "wp.array"
    normal: "wp.array"
    paired: "wp.array"


class Target(ABC):
    """A registration target.

    Attributes:
        device: Device on which the target is queried.
    """

    def __init__(self, device: "wp.Device") -> None:
        self.device = device
        self._room: Pairs | None = None

    @abstractmethod
    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        """Partners within the distance for moved points, vec3d (N,) [world]; the next call overwrites them."""

    def tilts(self, moved: "wp.array", pairs: Pairs) -> tuple[Pairs, "wp.array"] | None:
        """The last pairs with normals, and the squared uncertainty of each normal [rad^2], float64 (N,).

        None if the normals are exact at the moved points: a surface's, or a cloud's with samples of the same places.
        """
        return None

    def room(self, count: int) -> Pairs:
        """Arrays for so many pairs, reused by every step."""
        import warp as wp

        if self._room is None or len(self._room.paired) != count:
            self._room = Pairs(
                wp.empty(count, dtype=wp.vec3d, device=self.device),
                wp.empty(count, dtype=wp.vec3d, device=self.device),
                wp.empty(count, dtype=wp.int32, device=self.device),
            )
        return self._room


def make_target(target: Any, target_normals: Any, wants_normals: bool, device: Any) -> Target:
    """The Target for a ``target`` argument.

    Raises:
        InputError: The argument is not a valid target, or the normals do not fit it.
    """
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.objects import require_mesh
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.model.sparse_volume import SparseVolume

    if isinstance(target, TriangleMesh) or has_faces(target, "target"):
        target = Surface(require_mesh(target, "target", images=False), device=device)
    if isinstance(target, (Surface, SparseVolume)):
        if target_normals is not None:
            kind = type(target).__name__
            raise InputError(f"target_normals: a {kind} has its own; give them with a cloud only")
        return _SurfaceTarget(snapshot(target)) if isinstance(target, Surface) else _VolumeTarget(target, device)
    return _CloudTarget(target, target_normals, wants_normals, launcher.resolve_device(device))


class _CloudTarget(Target):
    def __init__(self, points: Any, normals: Any, wants_normals: bool, device: "wp.Device") -> None:
        import warp as wp

        super().__init__(device)
        self._points = read_vectors(points, "target", device, largest=LARGEST_MEASURED).array
        if len(self._points) == 0:
            raise InputError("target: it has no points; give at least one")
        self._normals = wp.empty(0, dtype=wp.vec3d, device=device)
        if normals is not None:
            self._normals = read_vectors(normals, "target_normals", device).array
            if len(self._normals) != len(self._points):
                raise InputError(
                    f"target_normals: {len(self._normals)} rows for {len(self._points)} points; give one for each"
                )
            self._normals = _unit(self._normals)
        elif wants_normals:
            self._estimate_normals()
        self._wants_normals = wants_normals
        self._tree = build_tree(self._points)
        self._partner: Any = None

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        import warp as wp

        from geokit.points.clouds.register_kernels import limit_kernel, partner_kernel

        limit: Any = max_distance * max_distance
        if self._partner is not None:
            # The search radius is the distance to the previous partner: most searches end where they begin.
            given = [moved, self._points, self._partner, wp.float64(limit)]
            limit = wp.empty(len(moved), dtype=wp.float64, device=self.device)
            launcher.launch(limit_kernel, len(moved), given, [limit], self.device)
        _, indices = nearest(self._tree, 1, moved, limit_squared=limit)
        self._partner = indices.flatten()
        room = self.room(len(moved))
        inputs = [self._partner, self._points, self._normals, False]
        launcher.launch(partner_kernel, len(moved), inputs, [*room], self.device)
        return room

    def tilts(self, moved: "wp.array", pairs: Pairs) -> tuple[Pairs, "wp.array"] | None:
        import warp as wp

        from geokit.points.clouds import register_kernels as kernels

        if len(self._points) < int(kernels.AROUND):
            return None
        distance, around = nearest(self._tree, int(kernels.AROUND), moved)
        near = distance.numpy()[:, :2]
        if np.median(near[:, 0] - SAME_PLACES * near[:, 1]) <= 0.0:
            return None
        if not self._wants_normals:
            if not len(self._normals):
                self._estimate_normals()
            inputs = [self._partner, self._points, self._normals, False]
            launcher.launch(kernels.partner_kernel, len(moved), inputs, [*pairs], self.device)
        tilt = wp.empty(len(moved), dtype=wp.float64, device=self.device)
        inputs = [moved, self._points, self._normals, around]
        launcher.launch(kernels.tilt_kernel, len(moved), inputs, [tilt], self.device)
        return pairs, tilt

    def _estimate_normals(self) -> None:
        from geokit.points._normals import normals

        # Signs do not affect distances from planes.
        self._normals = normals(self._points, k=NORMAL_NEIGHBORS, orientation="none", device=self.device).normals


class _SurfaceTarget(Target):
    def __init__(self, surface: "Surface") -> None:
        import warp as wp

        super().__init__(launcher.resolve_device(surface.device))
        self._surface = surface
        corners = surface.mesh.vertices[surface.mesh.faces]
        # Scale to unit size before multiplying, so that products of very long or short edges stay in the float64 range.
        edges = (corners[:, 1:] - corners[:, :1]) / surface.scale
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # A triangle without area has no plane; a zero normal takes no part.
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
        self._normals = wp.array(normals, dtype=wp.vec3d, device=self.device)

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        from geokit.points.clouds.register_kernels import partner_kernel

        found = self._surface.closest_point(moved, max_distance=max_distance)
        room = self.room(len(moved))
        inputs = [found.triangle_id, found.points, self._normals, True]
        launcher.launch(partner_kernel, len(moved), inputs, [*room], self.device)
        return room


class _VolumeTarget(Target):
    def __init__(self, volume: "SparseVolume", device: Any) -> None:
        from geokit.volume.at_points.sample import is_scalar

        info = volume.info
        if info.grid_class != "level set" or not is_scalar(volume):
            raise InputError(
                f"target: grid {info.name!r} is a {info.grid_class} of type {info.grid_type}, not a signed distance; "
                "give a level set, as geokit.volume.from_mesh makes it"
            )
        super().__init__(launcher.resolve_device(device))
        self._volume = volume
        self._reach = abs(float(info.background)) - BAND_MARGIN * float(np.max(info.voxel_size))

    def pairs(self, moved: "wp.array", max_distance: float) -> Pairs:
        import warp as wp

        from geokit.points.clouds.register_kernels import volume_partner_kernel

        distance = self._volume.sample(moved, device=self.device)
        gradient = self._volume.gradient(moved, device=self.device)
        room = self.room(len(moved))
        inputs = [moved, distance, gradient, wp.float64(min(max_distance, self._reach))]
        launcher.launch(volume_partner_kernel, len(moved), inputs, [*room], self.device)
        return room


def _unit(normals: "wp.array") -> "wp.array":
    import warp as wp

    from geokit.points.clouds.register_kernels import unit_kernel

    unit = wp.empty(len(normals), dtype=wp.vec3d, device=normals.device)
    launcher.launch(unit_kernel, len(normals), [normals], [unit], normals.device)
    return unit
