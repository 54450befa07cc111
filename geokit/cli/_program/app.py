"""The verbs by name. A verb's module is imported only when it is used, which keeps start-up short."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter, UnknownOptionError

import geokit
from geokit._shipped import folder_of

VERBS = {
    "info": "Describe a mesh, a volume or a point cloud.",
    "convert": "Convert between mesh formats, volume formats, and from one to the other.",
    "repair": "Merge vertices, wind faces alike, fill holes; say what was done.",
    "wrap": "Make a closed mesh around anything: holes, loose triangles, sheets, points.",
    "boolean": "Unite, subtract or intersect closed meshes.",
    "hollow": "Hollow a closed part: walls of one thickness, measured, and holes to drain it.",
    "compare": "Measure how far a scan is from its design: numbers, a page with a map, or a file of deviations.",
    "query": "Find closest points, signed distances, ray hits, samples or neighbors.",
    "mesh": "Make simple bodies; split, move and color meshes.",
    "volume": "Combine, offset, smooth, resample, differentiate, segment and measure volumes.",
    "batch": "Run a recipe of these commands on many files, on this machine or on many; resumable.",
    "plan": "List the distance fields of a mesh that keep a tolerance, with memory, time and error.",
    "bench": "Chart accuracy against speed of geokit's methods on your data, or find where they fail.",
    "render": "Draw a mesh, a volume or a point cloud into a PNG file, off-screen.",
    "view": "Show meshes, volumes and point clouds in a browser: one HTML file to turn, slice and click.",
    "guide": "List the guides, or print one of them as a program.",
    "doctor": "Report what works on this machine, what does not, and the command that mends it.",
    "demo": "Run the whole chain on a real mesh; write files, figures and a table of accuracy and speed.",
}
# Verbs whose module defines subcommands.
GROUPS = ("query", "mesh", "boolean", "volume")
# Parameters that are files, the last of which is written.
OUTPUTS = frozenset(("target", "result", "files"))
# What to try first, for the help of the program.
FIRST = """\
geokit info bunny.usd
geokit view bunny.usd -o bunny.html
geokit convert bunny.usd bunny.vdb --voxel-size 0.01 --half-width 3
geokit guide
"""


def build_commands() -> App:
    """The commands alone, without the options of all."""
    app = App(
        name="geokit",
        help="Closest points, rays, signed distance fields and neighbors, on meshes, sparse volumes and points.",
        version=geokit.__version__,
        version_flags=["--version", "-V"],
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    app.register_install_completion_command(help="Install tab completion for bash, zsh or fish.")
    for verb, summary in VERBS.items():
        target = "app" if verb in GROUPS else verb
        app.command(f"geokit.cli.{verb}:{target}", name=verb, help=summary)
    return app


def build_app() -> App:
    app = build_commands()

    @app.meta.default
    def launch(
        *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        reference_folder: Annotated[list[Path] | None, Parameter(negative="")] = None,
        memory_limit: int | None = None,
        cad_tolerance: float | None = None,
        time_step: int | None = None,
    ) -> Any:
        """Options for all commands.

        Args:
            tokens: The command and its own arguments.
            reference_folder: Folder in which files may lie that the input refers to, besides the input's own folder;
                may be given several times.
            memory_limit: Largest size in bytes to which the content of an input may decompress; by default a hundred
                times the file's size, at least 1 GiB, and at most half of the free memory.
            cad_tolerance: Largest distance in millimeters between a curved face of a .step or .iges and its triangles;
                by default 1e-4 of the diagonal of its box.
            time_step: Of an .xdmf with a time series: which one, from 0, or from -1 back from the last.
        """
        if tokens and tokens[0] == "help":
            tokens = (*tokens[1:], "--help")
        if reference_folder is memory_limit is cad_tolerance is time_step is None:
            return _run(app, tokens or ["--help"])
        # NumPy comes with these, and most commands do not need it to print their help.
        from geokit.core.content_limit import content_limit, set_default_limit
        from geokit.formats.file_content.references import allowed_folders, set_default_folders
        from geokit.formats.reading_defaults import set_reading_defaults

        set_reading_defaults(cad_tolerance, time_step)
        set_default_limit(None if memory_limit is None else content_limit(0, memory_limit))
        set_default_folders(allowed_folders(reference_folder or ()))
        try:
            return _run(app, tokens)
        finally:
            set_reading_defaults()
            set_default_limit(None)
            set_default_folders(())

    app.meta.suppress_keyboard_interrupt = False
    return app.meta


def _run(app: App, tokens: Sequence[str]) -> Any:
    """Run a command; of one that writes the last of its files, that may be said with -o, as others have it."""
    try:
        return app(tokens, exit_on_error=False, print_error=False)
    except UnknownOptionError:
        if (moved := _output_last(app, tokens)) is None:
            raise
    return app(moved, exit_on_error=False, print_error=False)


def _output_last(app: App, tokens: Sequence[str]) -> list[str] | None:
    """The words of a command with the file of -o or --output as the last one; None if it has no such file."""
    command = app.parse_commands(tokens)[1][-1].default_command
    places = [at for at, word in enumerate(tokens) if re.match(r"(-o|--output)(=|$)", word)]
    if command is None or len(places) != 1 or OUTPUTS.isdisjoint(inspect.signature(command).parameters):
        return None
    first, equals, file = tokens[places[0]].partition("=")
    after = tokens[places[0] + 1 :]
    if not equals:
        file, *after = after or [first]
    return [*tokens[: places[0]], *after, "--", file]


def examples_of(arguments: Sequence[str]) -> list[str]:
    """Examples of docs/cli.md for a command line that prints help: of its command, or of the group; [] for others."""
    asks = bool({"--help", "-h"}.intersection(arguments)) or arguments[:1] == ["help"]
    if not asks and arguments and not (len(arguments) == 1 and arguments[0] in GROUPS):
        return []
    words = [word for word in arguments if not word.startswith("-")]
    first = next((at for at, word in enumerate(words) if word in VERBS), len(words))
    words = words[first : first + 2]
    if not words:
        return FIRST.splitlines()
    page = (folder_of("docs") / "cli.md").read_text(encoding="utf-8")
    lines = re.findall("^geokit .*", page, re.MULTILINE)
    return [line for line in lines if line.split()[1:3] == words] or [
        line for line in lines if line.split()[1] == words[0]
    ]
