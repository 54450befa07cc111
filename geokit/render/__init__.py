"""Off-screen figures as PNG files: surfaces, volumes, points, slices, images and charts.

Nothing here needs a display. VTK draws the scenes and matplotlib the flat figures; both are imported on first use.
"""

from __future__ import annotations

from geokit.render._backend import gl_backend
from geokit.render._chart import Series, chart
from geokit.render._image import image
from geokit.render._scene import figure
from geokit.render._slice import slice_figure as slice  # the public name; inside the package it would hide the built-in

__all__ = ["Series", "chart", "figure", "gl_backend", "image", "slice"]
