"""A prepared surface as the user's own kernels take it."""

from __future__ import annotations

import math
from typing import Any

from geokit.core.memory.struct_array import handed_out
from geokit.errors import InputError
from geokit.mesh.queries.gradients import sloped_faces
from geokit.mesh.sign.queries import FAR
from geokit.mesh.topology.size_limits import require_measurable

__all__ = ["on_kernel"]


def on_kernel(surface: Any, sign: str | None) -> Any:
    """:meth:`geokit.mesh.Surface.on_kernel`."""
    import warp as wp

    from geokit.mesh.surfaces import user_kernels as kernels

    require_measurable(surface.mesh, surface._frame)
    found: Any = kernels.Surface()
    found.tree = surface._any_hit_tree
    found.faces = sloped_faces(surface, sign is not None)
    if sign is not None:
        method, judge = surface._method(sign), surface._signs
        if method == "parity":
            raise InputError("sign: 'parity' casts rays through the whole mesh; use 'winding' in kernels")
        found.is_trimmed = judge is not surface
        found.judge, found.winding, found.empty = judge._winding_arguments_of_all()
        found.sign = kernels.BY_WINDING
        if method == "pseudonormal":
            found.sign, found.pseudonormals = kernels.BY_PSEUDONORMALS, judge._pseudonormals
            found.outside = wp.float64(FAR * judge._frame.scale if judge.is_closed else math.inf)
    return handed_out(found, surface._device, surface)
