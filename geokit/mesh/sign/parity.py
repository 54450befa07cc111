"""Signs by the parity of crossed faces along rays, and whether points have no triangle within the radius."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop import user_arrays
from geokit.core.memory.pinned import host_flags

# Directions of the parity rays; none is along an axis or diagonal, where edges and vertices often line up.
PARITY_DIRECTIONS = (
    (0.7548776662, 0.5698402910, 0.3247179572),
    (-0.4142135, 0.7320508, -0.5412),
    (0.2360679, -0.6180, 0.7861513),
)


def any_missed(triangle_id: "wp.array") -> bool:
    """Whether a query has found no triangle."""
    from geokit.mesh.sign.parity_kernels import missed_kernel

    found = host_flags(1, triangle_id.device)
    launcher.launch(missed_kernel, len(triangle_id), [triangle_id], [found], triangle_id.device)
    return found.is_raised(0)


def by_parity(surface: Any, points: "wp.array", distance: "wp.array") -> None:
    """Give distances the sign that most rays in PARITY_DIRECTIONS show."""
    from geokit.mesh.sign.parity_kernels import parity_sign_kernel, vote_kernel

    count, device = len(points), points.device
    votes = wp.zeros(count, dtype=wp.int32, device=device)
    rays = user_arrays.Batch(points, False, lambda out: out)
    for direction in PARITY_DIRECTIONS:
        heading = wp.full(count, wp.vec3d(*direction), dtype=wp.vec3d, device=device)
        crossings = surface._count_crossings(rays, user_arrays.Batch(heading, False, lambda out: out), 0.0, np.inf)
        launcher.launch(vote_kernel, count, [crossings], [votes], device)
    needed = len(PARITY_DIRECTIONS) // 2 + 1
    launcher.launch(parity_sign_kernel, count, [votes, needed], [distance], device)
