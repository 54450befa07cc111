"""Warp as ``wp``, imported where it is first used: that takes 0.3 s, and files are read and written without it.

A module imports ``wp`` from here, once for all its functions.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import warp as wp
else:

    class _LateWarp:
        def __getattr__(self, name: str) -> Any:
            import warp

            # From now on every module has warp itself: what follows costs no more than after its own import.
            for module in [*sys.modules.values()]:
                if getattr(module, "__dict__", {}).get("wp") is self:
                    module.wp = warp
            return getattr(warp, name)

    wp = _LateWarp()
