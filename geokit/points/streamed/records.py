"""Points with their arrays as records in files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.blocks.points import Block
from geokit.formats.blocks.records import Known, RecordFile, survey
from geokit.formats.columns import Columns

__all__ = ["blocks_of", "known_of", "records_of", "sample_of", "type_of"]

# Points that stand for all where these are divided: 64 for each of 2000 parts, whose sizes then scatter by an eighth.
SAMPLE_SIZE = 1 << 17


def known_of(blocks: Iterable[Block], declared: int) -> Known:
    """Look at all points, of which there are about as many as declared."""
    return survey(blocks, max(1, declared // SAMPLE_SIZE))


def type_of(data: Columns) -> np.dtype[Any]:
    """The type of records with a position, ``points``, and arrays."""
    # A name of an array may be anything.
    arrays = [(f"data {name}", values.dtype, values.shape[1:]) for name, values in data.items()]
    return np.dtype([("points", np.float64, (3,)), *arrays])


def records_of(points: NDArray[np.float64], data: Columns) -> NDArray[Any]:
    """Points with arrays as records."""
    records = np.empty(len(points), type_of(data))
    records["points"] = points
    for name, values in data.items():
        records[f"data {name}"] = values
    return records


def sample_of(file: RecordFile, most: int) -> NDArray[np.float64]:
    """Positions of some records, evenly spaced."""
    return survey(((part["points"], {}) for part in file.parts()), max(1, file.count // most)).sample


def blocks_of(file: RecordFile) -> Iterator[Block]:
    """The points and their arrays; the first block has none."""
    names = [name for name in file.dtype.names or () if name.startswith("data ")]
    for part in chain([np.empty(0, file.dtype)], file.parts()):
        yield part["points"], {name[len("data ") :]: part[name] for name in names}
