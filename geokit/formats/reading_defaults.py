"""How meshes are read where the caller does not say: how finely curved faces become triangles, and which time step."""

from __future__ import annotations

_tolerance: float | None = None
_step: int | None = None


def default_tolerance() -> float | None:
    """Largest distance between a curved face and its triangles [unit of the mesh]; None for the reader's own."""
    return _tolerance


def default_step() -> int | None:
    """The time step of files that hold several; None for none."""
    return _step


def set_reading_defaults(cad_tolerance: float | None = None, time_step: int | None = None) -> None:
    """Set what holds where nothing is given.

    Raises:
        InputError: The tolerance is not positive.
    """
    global _tolerance, _step
    if cad_tolerance is not None:
        from geokit.core.interop.user_arrays import require_finite_scalar

        cad_tolerance = require_finite_scalar(cad_tolerance, "cad_tolerance", low=0.0)
    _tolerance, _step = cad_tolerance, time_step
