"""Runs a command line and turns every outcome into an exit code."""

from __future__ import annotations

import io
import os
import re
import sys
import traceback
import warnings

from geokit._packages import DISTRIBUTION, require_package
from geokit.cli._program.console import at_end
from geokit.core.base.printable import printable
from geokit.errors import GeokitError

FAILURE, USAGE = 1, 2
# The exit code that a shell reports for a command killed by SIGPIPE.
BROKEN_PIPE = 141
_HOME = re.compile(r"(?:^|(?<==))~(?=/|$)")
_STEPS = re.compile(r"with step=(\d+) to step=(\d+)$")


def run(arguments: list[str]) -> int:
    """Run the command line ``arguments`` and return the exit code; an interrupt goes on."""
    try:
        CycloptsError = require_package("cyclopts").CycloptsError
    except GeokitError as error:
        return _fail(str(error), FAILURE)
    from geokit.cli._program.app import build_app, examples_of

    app = build_app()
    warnings.showwarning = show_warning
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names of files need not be in any encoding.
        sys.stdout.reconfigure(errors="surrogateescape")
    try:
        with at_end:
            # As the shell does it for words that begin with it: not for --output=~/a.ply, nor in quotes.
            home = os.path.expanduser("~")
            result = app(
                [_HOME.sub(lambda _: home, word) for word in arguments], exit_on_error=False, print_error=False
            )
        if examples := examples_of(arguments):
            print("Examples:", *(f"  {line}" for line in examples), sep="\n")
        sys.stdout.flush()
    except CycloptsError as error:
        return _fail(usage_message(error), USAGE, hint=" (see geokit --help)")
    except GeokitError as error:
        # The library's message names its parameter; the user knows the option.
        return _fail(_STEPS.sub(r"with --time-step \1 to \2", str(error)), FAILURE)
    except Warning as error:  # python -W error
        return _fail(f"warning: {error}", FAILURE)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0] or str(error)
        return _fail(f"the Python package {package} is missing; pip install {DISTRIBUTION} brings it along", FAILURE)
    except BrokenPipeError:
        # The reader has closed the pipe, as in `geokit info ... | head`.
        _discard_output()
        return BROKEN_PIPE
    except OSError as error:
        # Files raise FileAccessError, so this is stdout, as on a full disk.
        _discard_output()
        what = error.filename or "standard output"
        return _fail(f"{what}: writing failed ({error.strerror or error}); check the disk", FAILURE)
    except MemoryError as error:
        return _fail(f"out of memory ({error or 'no details'}); use a smaller input or a larger voxel size", FAILURE)
    except Exception as error:
        hint = "" if _debugging() else "; GEOKIT_DEBUG=1 shows where"
        return _fail(f"internal error: {type(error).__name__}: {error}", FAILURE, hint=hint)
    return result if isinstance(result, int) else 0


def _discard_output() -> None:
    """Send stdout nowhere: Python would fail again when it flushes it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print a warning like other notices, without the place in the library that raised it."""
    print(f"geokit: warning: {printable(' '.join(str(message).split()))}", file=sys.stderr, flush=True)


def usage_message(error: BaseException) -> str:
    from cyclopts import UnknownCommandError, UnusedCliTokensError

    unused: list[str] = getattr(error, "unused_tokens", None) or []
    if unused == ["-"]:
        return "-: input is not read from a pipe, since the name of a file says what it is; name a file"
    if isinstance(error, UnusedCliTokensError):
        return f"{', '.join(map(repr, unused))}: one argument too many, or an option without its --; leave it out"
    if isinstance(error, UnknownCommandError) and unused[0].startswith("-"):
        return f"{unused[0]}: there is no such option before a command; write options of a command after its name"
    # Cyclopts names the command or the option that is meant. Some of its messages span several lines.
    return str(error).strip() or type(error).__name__


def _fail(message: str, code: int, *, hint: str = "") -> int:
    if _debugging() and code != USAGE:
        traceback.print_exc()
    line = printable(" ".join(message.split()))
    print(f"geokit: {line}{hint}", file=sys.stderr)
    return code


def _debugging() -> bool:
    return os.environ.get("GEOKIT_DEBUG", "") not in ("", "0")
