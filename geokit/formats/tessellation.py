"""How finely the curved faces of CAD files become triangles, where the caller does not say."""

from __future__ import annotations

__all__ = ["default_tolerance", "set_default_tolerance"]

_default: float | None = None


def default_tolerance() -> float | None:
    """Largest distance between a curved face and its triangles [unit of the mesh]; None for the reader's own."""
    return _default


def set_default_tolerance(tolerance: float | None) -> None:
    """Set the tolerance that holds where none is given.

    Raises:
        InputError: It is not positive.
    """
    global _default
    if tolerance is not None:
        from geokit.core.user_arrays import require_finite_scalar

        tolerance = require_finite_scalar(tolerance, "cad_tolerance", low=0.0)
    _default = tolerance
