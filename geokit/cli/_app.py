"""The verbs by name. A verb's module is imported only when it is used, which keeps start-up short."""

from __future__ import annotations

from cyclopts import App

import geokit

__all__ = ["VERBS", "build_app"]

VERBS = {
    "info": "Describe a mesh, a volume or a point cloud.",
    "convert": "Convert between mesh formats, volume formats, and from one to the other.",
    "query": "Find closest points, signed distances, ray hits, samples or neighbors.",
    "volume": "Combine, offset, smooth, resample, differentiate, segment and measure volumes.",
    "plan": "List the distance fields of a mesh that keep a tolerance, with memory, time and error.",
    "bench": "Chart accuracy against speed of geokit's methods on your data, or find where they fail.",
    "render": "Draw a mesh, a volume or a point cloud into a PNG file, off-screen.",
    "doctor": "Report versions, devices, libraries and the kernel cache.",
    "demo": "Run the whole chain on a real mesh; write files, figures and a table of accuracy and speed.",
}
# Verbs whose module defines subcommands.
GROUPS = ("query", "volume")


def build_app() -> App:
    app = App(
        name="geokit",
        help="Closest points, rays, signed distance fields and neighbors, on meshes, sparse volumes and points.",
        version=geokit.__version__,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for verb, summary in VERBS.items():
        target = "app" if verb in GROUPS else verb
        app.command(f"geokit.cli.{verb}:{target}", name=verb, help=summary)
    return app
