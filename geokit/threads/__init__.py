"""All threads of a CPU for the user's own kernels: warp runs a launch there on one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.threads._team_kernels import Share, barrier, item
    from geokit.threads.team import Team

__all__ = ["Share", "Team", "barrier", "item"]

make_lazy(
    __name__,
    {
        "Share": "geokit.threads._team_kernels",
        "Team": "geokit.threads.team",
        "barrier": "geokit.threads._team_kernels",
        "item": "geokit.threads._team_kernels",
    },
)
