"""Surfaces from which faces inside of the solid were left out, with the signs of all faces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.memory.pinned import host_flags
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.points import ClosestPoints
from geokit.mesh.surfaces.surface import Surface

if TYPE_CHECKING:
    import warp as wp

__all__ = ["TrimmedSurface"]


class TrimmedSurface(Surface):
    """A surface without faces that have the same on both sides; what is inside is said by the winding numbers of all.

    Args:
        mesh: The faces that are left, or their pieces; where some are missing there may be holes.
        given: The surface of all faces.
    """

    _is_trimmed = True

    def __init__(self, mesh: TriangleMesh, given: Surface) -> None:
        super().__init__(mesh, device=given._device)
        self.__dict__.update(_single_faced=given._signs, _solid_choice=given._solid_choice)

    def contains(self, points: Any, *, sign: str = "auto", **options: Any) -> Any:
        """Whether points lie inside: also those on faces that were left out, where :class:`Surface` says no."""
        import warp as wp

        winding = self._signs.winding_number(points, **options)
        if isinstance(winding, wp.array):
            return wp.array(winding.numpy() > 0.5, dtype=wp.bool, device=winding.device)
        return winding > 0.5

    def _sign(self, method: str, points: "wp.array", closest: ClosestPoints, reach: float) -> None:
        import warp as wp

        from geokit.mesh.sign.parity_kernels import take_sign_kernel

        winding = self._signs._winding(points, host_flags(1, self._device)).numpy()
        side = wp.array(np.where(winding > 0.5, -1.0, 1.0), dtype=wp.float64, device=self._device)
        launcher.launch(take_sign_kernel, len(points), [side], [closest.distance], self._device)
