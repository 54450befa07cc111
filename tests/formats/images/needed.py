"""Which package a format of dense volumes needs."""

from __future__ import annotations

import importlib.util

import pytest

from geokit.formats.table import FORMATS

__all__ = ["need"]

PACKAGES = {
    "nifti": "nibabel", "nrrd": "nrrd", "mrc": "mrcfile", "tiff": "tifffile", "dicom": "pydicom", "zarr_image": "zarr",
}  # fmt: skip


def need(kind: str) -> None:
    """Skip a test of a format whose package is not installed."""
    package = PACKAGES.get(FORMATS[kind].image)
    if package and not importlib.util.find_spec(package):
        pytest.skip(f"needs {package}")
