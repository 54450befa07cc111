"""Runs a command line and turns every outcome into an exit code."""

from __future__ import annotations

import os
import sys
import traceback
import warnings

from geokit.errors import GeokitError

__all__ = ["run"]

FAILURE, USAGE, INTERRUPTED = 1, 2, 130
# The exit code that a shell reports for a command killed by SIGPIPE.
BROKEN_PIPE = 141


def run(arguments: list[str]) -> int:
    """Run the command line ``arguments`` and return the exit code."""
    from cyclopts import CycloptsError

    from geokit.cli._app import build_app

    app = build_app()
    warnings.showwarning = _show_warning
    try:
        result = app(arguments or ["--help"], exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except CycloptsError as error:
        return _fail(_usage_message(error), USAGE, hint=" (see geokit --help)")
    except GeokitError as error:
        return _fail(str(error), FAILURE)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0] or str(error)
        return _fail(f"the Python package {package} is not installed; pip install geokit brings it along", FAILURE)
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader has closed the pipe, as in `geokit info ... | head`. Without this, Python would fail again when it
        # flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except MemoryError as error:
        return _fail(f"out of memory ({error or 'no details'}); use a smaller input or a larger voxel size", FAILURE)
    except Exception as error:
        hint = "" if _debugging() else "; GEOKIT_DEBUG=1 shows where"
        return _fail(f"internal error: {type(error).__name__}: {error}", FAILURE, hint=hint)
    return result if isinstance(result, int) else 0


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print a warning like other notices, without the place in the library that raised it."""
    print(f"geokit: warning: {' '.join(str(message).split())}", file=sys.stderr, flush=True)


def _usage_message(error: Exception) -> str:
    # Some messages of Cyclopts span several lines.
    return str(error).strip() or type(error).__name__


def _fail(message: str, code: int, *, hint: str = "") -> int:
    if _debugging() and code not in (USAGE, INTERRUPTED):
        traceback.print_exc()
    line = " ".join(message.split())
    print(f"geokit: {line}{hint}", file=sys.stderr)
    return code


def _debugging() -> bool:
    return os.environ.get("GEOKIT_DEBUG", "") not in ("", "0")
