"""How a command stores volumes: what ``--codec`` and ``--tolerance`` say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.volume._model import SparseVolume

__all__ = ["Storage"]

COMPRESSIONS = ("none", "zip", "blosc")
QUANTISATIONS = ("float", "fp4", "fp8", "fp16", "fpn")


@dataclass(frozen=True)
class Storage:
    """What is done to volumes before they are saved, and how the file is compressed.

    Attributes:
        compression: For :func:`geokit.volume.save`; None for its default.
        quantisation: For :func:`geokit.volume.quantize`; None for none, or for what the tolerance allows.
        tolerance: By how much a voxel may change [value units].
    """

    compression: str | None
    quantisation: str | None
    tolerance: float | None

    @classmethod
    def of(cls, codec: str | None, tolerance: float | None) -> Storage:
        """The storage that the options name.

        Raises:
            InputError: A word of the codec is unknown, or there are two of a kind.
        """
        words = [word.strip().lower() for word in (codec or "").split(",") if word.strip()]
        for word in words:
            if word not in COMPRESSIONS + QUANTISATIONS:
                known = ", ".join(COMPRESSIONS + QUANTISATIONS)
                raise InputError(f"codec: {word!r} is unknown; use one of {known}, or two such as fp8,zip")
        compressions = [word for word in words if word in COMPRESSIONS]
        quantisations = [word for word in words if word in QUANTISATIONS]
        if len(compressions) > 1 or len(quantisations) > 1:
            raise InputError(f"codec: {codec!r} names two of a kind; use at most one compression and one quantisation")
        if quantisations == ["fpn"] and tolerance is None:
            raise InputError("codec: fpn needs --tolerance; say by how much a voxel may change")
        return cls(compressions[0] if compressions else None, quantisations[0] if quantisations else None, tolerance)

    def applied(self, volume: SparseVolume) -> SparseVolume:
        """The volume as it is saved."""
        if self.quantisation is None and self.tolerance is None:
            return volume
        from geokit.volume._quantize import quantize

        return quantize(volume, self.quantisation, tolerance=self.tolerance)

    def described(self, volumes: Sequence[SparseVolume]) -> dict[str, Any]:
        """What a summary says of it."""
        if self.quantisation is None and self.tolerance is None:
            return {}
        from geokit.volume.nanovdb.provenance import ACHIEVED_ERROR

        return {
            "types": ", ".join(volume.info.grid_type for volume in volumes),
            "achieved_error": max(float(volume.info.metadata.get(ACHIEVED_ERROR, 0.0)) for volume in volumes),
        }
