"""What the files of other programs hold. Numbers have few binary digits, so that text and float32 keep them."""

from __future__ import annotations

import numpy as np

__all__ = [
    "CLOUD", "COLORS", "FACES", "FACE_IDS", "HEIGHTS", "IMAGE", "INDICES", "INTENSITY", "NORMALS", "ORIGIN",
    "POINT_COLORS", "SPACING", "VALUES", "VERTICES", "VOXEL_SIZE",
]  # fmt: skip

_RANDOM = np.random.default_rng(11)

# A closed pyramid without symmetry.
VERTICES = np.array([[0, 0, 0], [2, 0, 0.125], [2.25, 1.5, 0], [-0.5, 1, 0.25], [0.75, 0.625, 3]])
FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [17, 34, 51]], np.uint8)
HEIGHTS = VERTICES[:, 2].copy()
FACE_IDS = np.array([7, -1, 3, 0, 2, 40], np.int32)

CLOUD = _RANDOM.integers(-6400, 6400, (40, 3)) / 64
POINT_COLORS = _RANDOM.integers(0, 256, (40, 3)).astype(np.uint8)
INTENSITY = _RANDOM.integers(0, 256, 40) / 256
NORMALS = np.eye(3)[_RANDOM.integers(0, 3, 40)] * _RANDOM.choice([-1, 1], (40, 1))

# By x, y, z. The voxel [0, 0, 0] lies at ORIGIN.
IMAGE = _RANDOM.integers(1, 200, (5, 6, 7)).astype(np.int16)
SPACING = np.array([0.5, 0.25, 2.0])
ORIGIN = np.array([1.0, -2.0, 3.0])

# Active voxels of a sparse grid.
INDICES = np.unique(_RANDOM.integers(0, 12, (60, 3)), axis=0).astype(np.int32)
VALUES = _RANDOM.integers(-4096, 4096, len(INDICES)).astype(np.float32) / 1024
VOXEL_SIZE = 0.5
