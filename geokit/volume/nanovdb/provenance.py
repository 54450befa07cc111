"""Provenance and accuracy of a volume, as metadata of its grid.

The keys are stored in .vdb as OpenVDB metadata and in .nvdb as a channel of blind data
(:mod:`geokit.volume.nanovdb.metadata`). A key that does not apply is absent.

============================  =============================================================================
``geokit:source``             name of the source of the volume: a mesh, a file, a function
``geokit:source_sha256``      SHA-256 of its content in hexadecimal, see :func:`content_hash`
``geokit:voxel_size``         requested or chosen edge length of a voxel [world]
``geokit:tolerance``          requested error [value units]
``geokit:achieved_error``     achieved error, at most the tolerance [value units]
``geokit:achieved_error_999`` its 99.9th percentile, if it was found by sampling [value units]
``geokit:checked_within``     distance from the surface up to which it holds [world]
``geokit:order``              order of interpolation for which it holds
``geokit:level``              number of a level of an adaptive field, 0 the coarsest
``geokit:level_count``        number of its levels
``geokit:unit``               unit of lengths in the world, if its source said so: m, cm, mm, um, nm or angstrom
``geokit:space``              where the axes of the world point in a body, if its file said so: RAS, LPS, ...
``geokit:meters_per_unit``    length of that unit [m], where it is none of these
``geokit:up_axis``            axis of the world that points up, if its source said so: x, y or z
``geokit:version``            version of geokit that made the volume
``geokit:file:NAME``          metadata NAME of the .vdb file itself, which the next one gets (geokit.native)
============================  =============================================================================
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.images.image import METERS

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

SOURCE = "geokit:source"
SOURCE_HASH = "geokit:source_sha256"
VOXEL_SIZE = "geokit:voxel_size"
TOLERANCE = "geokit:tolerance"
ACHIEVED_ERROR = "geokit:achieved_error"
ACHIEVED_999 = "geokit:achieved_error_999"
WITHIN = "geokit:checked_within"
ORDER = "geokit:order"
INTERIOR = "geokit:interior"
UNIT = "geokit:unit"
METERS_PER_UNIT = "geokit:meters_per_unit"
SPACE = "geokit:space"
UP_AXIS = "geokit:up_axis"
VERSION = "geokit:version"


def provenance(
    source_name: str | None = None,
    source_hash: str | None = None,
    voxel_size: float | None = None,
    tolerance: float | None = None,
    achieved_error: float | None = None,
    achieved_error_999: float | None = None,
    checked_within: float | None = None,
    order: int | None = None,
) -> dict[str, Any]:
    """Metadata that records the source and the accuracy of a volume.

    Args:
        source_name: Name of the source.
        source_hash: SHA-256 of the source, from :func:`content_hash`.
        voxel_size: Edge length of a voxel [world].
        tolerance: Requested error [value units].
        achieved_error: Achieved error [value units].
        achieved_error_999: Its 99.9th percentile [value units].
        checked_within: Distance from the surface up to which the error holds [world].
        order: Order of interpolation for which it holds.
    Returns:
        The keys of this module's table whose values are known, and the version of geokit.
    """
    import geokit

    known = {
        SOURCE: source_name,
        SOURCE_HASH: source_hash,
        VOXEL_SIZE: None if voxel_size is None else float(voxel_size),
        TOLERANCE: None if tolerance is None else float(tolerance),
        ACHIEVED_ERROR: None if achieved_error is None else float(achieved_error),
        ACHIEVED_999: None if achieved_error_999 is None else float(achieved_error_999),
        WITHIN: None if checked_within is None else float(checked_within),
        ORDER: order,
        VERSION: geokit.__version__,
    }
    return {key: value for key, value in known.items() if value is not None}


def with_error(metadata: Mapping[str, Any], tolerance: float | None, achieved_error: float) -> Mapping[str, Any]:
    """Metadata of a volume after another step that changed its values.

    Errors add up, and so do their tolerances. Without a tolerance for this step there is none for the whole.

    Args:
        metadata: Metadata of the volume before the step.
        tolerance: Requested error of the step [value units]; None if none was.
        achieved_error: Largest change of a value in the step [value units].
    """
    made = {**metadata, **provenance()}
    # Errors found by sampling do not apply to the changed values.
    made.pop(ACHIEVED_999, None)
    before = known_number(made.pop(ACHIEVED_ERROR, None))
    asked = known_number(made.pop(TOLERANCE, None))
    made[ACHIEVED_ERROR] = (before or 0.0) + float(achieved_error)
    if tolerance is not None and (before is None or asked is not None):
        made[TOLERANCE] = (asked or 0.0) + float(tolerance)
    return MappingProxyType(made)


def with_more(volume: SparseVolume, more: Mapping[str, Any]) -> SparseVolume:
    """Add metadata in place to a volume that was just made, and that no other code has seen yet."""
    metadata = MappingProxyType({**volume.info.metadata, **more})
    object.__setattr__(volume, "info", replace(volume.info, metadata=metadata))
    return volume


def world_metadata(meters_per_unit: float | None, up_axis: str | None) -> dict[str, Any]:
    """What metadata say of the length of the world's unit [m] and of the axis that points up; of None nothing."""
    meters = meters_per_unit
    unit = meters and next((name for name, size in METERS.items() if math.isclose(size, meters, rel_tol=1e-9)), None)
    said = {UNIT: unit, METERS_PER_UNIT: None if unit else meters, UP_AXIS: up_axis}
    return {key: value for key, value in said.items() if value is not None}


def world_of(metadata: Mapping[str, Any]) -> tuple[float | None, str | None]:
    """``meters_per_unit`` and ``up_axis`` that metadata say, each None if they do not."""
    meters = METERS.get(str(metadata.get(UNIT)), known_number(metadata.get(METERS_PER_UNIT)))
    up_axis = str(metadata.get(UP_AXIS))
    return (meters if meters and 0.0 < meters < math.inf else None), (up_axis if up_axis in ("x", "y", "z") else None)


def content_hash(*arrays: NDArray[Any]) -> str:
    """SHA-256 of arrays: of their types, shapes and little-endian bytes, in hexadecimal.

    Args:
        arrays: The source of a volume, such as the vertices and faces of a mesh.
    """
    digest = hashlib.sha256()
    for array in arrays:
        plain = np.ascontiguousarray(array)
        plain = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{plain.dtype.str}{plain.shape}".encode("ascii"))
        digest.update(plain.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def known_number(value: Any) -> float | None:
    """A metadata value as a number, or None: in a file, one of geokit's keys may hold any type."""
    return float(value) if isinstance(value, (int, float, np.number)) and not isinstance(value, bool) else None
