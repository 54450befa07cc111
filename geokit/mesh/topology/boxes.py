"""Bounding boxes of parts of a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory.needs import require_free

# Memory for the corners of a face and their bounds.
BYTES_PER_FACE = 200


def boxes_of(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], label: NDArray[Any], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates of the faces of each label [world] (count, 3).

    Args:
        vertices: Positions [world] (V, 3).
        faces: Vertex indices (F, 3).
        label: Label of each face (F,), from 0 to ``count``; each has a face.
        count: Number of labels.

    Raises:
        DeviceMemoryError: There is not enough memory for it.
    """
    # NumPy's reductions end the process where there is no memory for their buffers.
    require_free(BYTES_PER_FACE * len(faces), "boxes of parts", always=True)
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(count))
    # NumPy reduces an axis of three several times slower.
    a, b, c = (np.take(vertices, corner, axis=0) for corner in faces[order].T)
    lower: NDArray[np.float64] = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), starts, axis=0)
    upper: NDArray[np.float64] = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), starts, axis=0)
    return lower, upper
