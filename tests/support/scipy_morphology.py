"""Growing and shrinking by scipy and by geokit, under the same names."""

from __future__ import annotations

from scipy import ndimage

from geokit.volume._morphology import closing, dilate, erode, opening

CONNECTIVITY = {"faces": 1, "edges": 2, "vertices": 3}
SCIPY = {
    "dilate": ndimage.binary_dilation,
    "erode": ndimage.binary_erosion,
    "opening": ndimage.binary_opening,
    "closing": ndimage.binary_closing,
}
GEOKIT = {"dilate": dilate, "erode": erode, "opening": opening, "closing": closing}
