"""Off-screen figures: scenes as PNG; slices, images and charts also as SVG and PDF; interactive pages as HTML.

Nothing here needs a display. VTK draws the scenes and matplotlib the flat figures; both are imported on first use. A
browser draws the pages.
"""

from __future__ import annotations

from geokit.render._backend import gl_backend
from geokit.render._chart import Series, chart
from geokit.render._image import image
from geokit.render._scene import figure
from geokit.render._slice import slice_figure as slice  # the public name; inside the package it would hide the built-in
from geokit.render._view import Page, view

__all__ = ["Page", "Series", "chart", "figure", "gl_backend", "image", "slice", "view"]
