"""The options ``--codec`` and ``--tolerance``: compression and quantization of stored volumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

COMPRESSIONS = ("none", "zip", "blosc")
QUANTIZATIONS = ("float", "fp4", "fp8", "fp16", "fpn")


@dataclass(frozen=True)
class Storage:
    """Quantization of volumes before they are saved, and compression of the file.

    Attributes:
        compression: Codec for :func:`geokit.volume.save`; None for its default.
        quantization: Codec for :func:`geokit.volume.quantize`; None for no quantization, or for the smallest codec that
            keeps the tolerance if one is given.
        tolerance: Largest change of a voxel [value units].
    """

    compression: str | None
    quantization: str | None
    tolerance: float | None

    @classmethod
    def of(cls, codec: str | None, tolerance: float | None) -> Storage:
        """Parse the two options.

        Raises:
            InputError: A word of the codec is unknown, the codec names two compressions or two quantizations, or it is
                fpn without a tolerance.
        """
        words = [word.strip().lower() for word in (codec or "").split(",") if word.strip()]
        for word in words:
            if word not in COMPRESSIONS + QUANTIZATIONS:
                known = ", ".join(COMPRESSIONS + QUANTIZATIONS)
                raise InputError(f"codec: {word!r} is unknown; use one of {known}, or two such as fp8,zip")
        compressions = [word for word in words if word in COMPRESSIONS]
        quantizations = [word for word in words if word in QUANTIZATIONS]
        if len(compressions) > 1 or len(quantizations) > 1:
            raise InputError(f"codec: {codec!r} names two of a kind; use at most one compression and one quantization")
        if quantizations == ["fpn"] and tolerance is None:
            raise InputError("codec: fpn needs --tolerance; say by how much a voxel may change")
        return cls(compressions[0] if compressions else None, quantizations[0] if quantizations else None, tolerance)

    def applied(self, volume: SparseVolume) -> SparseVolume:
        """Quantize the volume as the options demand."""
        if self.quantization is None and self.tolerance is None:
            return volume
        from geokit.volume.retyped.quantize import quantize

        return quantize(volume, self.quantization, tolerance=self.tolerance)

    def described(self, volumes: Sequence[SparseVolume]) -> dict[str, Any]:
        """Entries of the summary: the stored types and the largest error."""
        if self.quantization is None and self.tolerance is None:
            return {}
        return {
            "types": ", ".join(volume.info.grid_type for volume in volumes),
            "achieved_error": max(volume.info.achieved_error or 0.0 for volume in volumes),
        }
