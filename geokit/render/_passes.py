"""How a scene becomes pixels: super-sampled, with layers of what can be seen through in their order."""

from __future__ import annotations

from typing import Any

__all__ = ["smooth_edges"]

# Layers that can be seen through each other; those behind are left out.
MOST_LAYERS = 12


def smooth_edges(plotter: Any) -> None:
    """Draw with super-sampling, and translucent surfaces by depth peeling, which does not depend on their order.

    VTK's own switch for depth peeling has no effect together with super-sampling.
    """
    translucent = any(actor.HasTranslucentPolygonalGeometry() for actor in plotter.renderer.actors.values())
    if not translucent:
        plotter.enable_anti_aliasing("ssaa")
        return
    from vtkmodules import vtkRenderingOpenGL2 as vtk

    plotter.render_window.SetAlphaBitPlanes(1)
    plotter.render_window.SetMultiSamples(0)
    peeling, steps, smooth = vtk.vtkDepthPeelingPass(), vtk.vtkRenderStepsPass(), vtk.vtkSSAAPass()
    peeling.SetTranslucentPass(vtk.vtkTranslucentPass())
    peeling.SetMaximumNumberOfPeels(MOST_LAYERS)
    peeling.SetOcclusionRatio(0.0)
    steps.SetTranslucentPass(peeling)
    smooth.SetDelegatePass(steps)
    plotter.renderer.SetPass(smooth)
