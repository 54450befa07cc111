"""The verbs by name. Each module is imported when its verb is used: start-up pays for one, not for all."""

from __future__ import annotations

from cyclopts import App

import geokit

__all__ = ["VERBS", "build_app"]

VERBS = {
    "info": "Describe a mesh, a volume or a point cloud.",
    "convert": "Convert between mesh formats, volume formats, and from one to the other.",
    "query": "Ask for closest points, signed distances, ray hits, samples or neighbours.",
    "volume": "Combine, move, smooth, resample, differentiate, take apart and measure volumes.",
    "plan": "List the distance fields of a mesh that keep a tolerance, with memory, time and error.",
    "bench": "Chart geokit's methods on your data, accuracy against speed, or to where they fail.",
    "render": "Draw a mesh, a volume or a point cloud into a PNG file, off-screen.",
    "doctor": "Report versions, devices, libraries and the kernel cache.",
    "demo": "Run the whole chain on a real mesh and leave files, figures and a table of accuracy and speed.",
}
# Those whose module has commands of its own.
GROUPS = ("query", "volume")


def build_app() -> App:
    app = App(
        name="geokit",
        help="Closest points, rays, signed distance fields and neighbours, on meshes, sparse volumes and points.",
        version=geokit.__version__,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for verb, summary in VERBS.items():
        target = "app" if verb in GROUPS else verb
        app.command(f"geokit.cli.{verb}:{target}", name=verb, help=summary)
    return app
