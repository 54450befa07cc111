"""Chooses the OpenGL library that renders without a display.

VTK can search for one, but if it finds none it crashes the process. So the choice is made here, before the first
window, among the libraries that can be loaded.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import glob
import importlib.util
import os
from pathlib import Path
from typing import Any

from geokit._packages import require_package
from geokit.errors import MissingDependencyError

EGL = "vtkEGLRenderWindow"
OSMESA = "vtkOSOpenGLRenderWindow"
BACKENDS = {"EGL": EGL, "OSMesa": OSMESA}

_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
_LIBRARIES = {EGL: ("libEGL.so.1",), OSMESA: ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
# With a GPU, EGL renders on it. Without one, OSMesa starts faster than EGL's software renderer.
_GPU_NODES = ("/dev/dri/renderD*", "/dev/nvidiactl")


@functools.lru_cache(maxsize=1)
def gl_backend() -> str:
    """The render window class of this process: "vtkEGLRenderWindow" or "vtkOSOpenGLRenderWindow".

    If VTK_DEFAULT_OPENGL_WINDOW names one of them, that class is tried first. The variable is set to the result.

    Returns:
        The name of the VTK class.
    Raises:
        MissingDependencyError: Neither EGL nor OSMesa works here.
    """
    _load_triton()
    preferred = (EGL, OSMESA) if any(glob.glob(pattern) for pattern in _GPU_NODES) else (OSMESA, EGL)
    wanted = os.environ.get(_VARIABLE, "")
    for name in dict.fromkeys([*([wanted] if wanted in _LIBRARIES else []), *preferred]):
        if _loads(name) and (name != EGL or _egl_draws()):
            os.environ[_VARIABLE] = name
            return name
    raise MissingDependencyError(
        "off-screen figures need EGL or OSMesa, and neither works here; apt install libegl1 libgl1 (or libosmesa6)"
    )


def _load_triton() -> None:
    """Loads triton's library, if torch brought one, before the first window loads Mesa's.

    Both hold a copy of LLVM. Mesa makes its own visible to every library that is loaded later, and triton 3.7 and
    later then call it: `import torch._dynamo` after a figure ended the process. In this order each keeps its own.
    """
    found = importlib.util.find_spec("triton")
    if found is None or found.origin is None:
        return
    library = Path(found.origin).parent / "_C" / "libtriton.so"
    with contextlib.suppress(OSError):  # absent, or built for another system: triton's import says so better
        ctypes.CDLL(str(library))


def _loads(name: str) -> bool:
    for library in _LIBRARIES[name]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False


def _egl_draws() -> bool:
    """Whether EGL can open a context; its library loads even without a driver."""
    vtkEGLRenderWindow = require_package("vtkmodules.vtkRenderingOpenGL2").vtkEGLRenderWindow
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    warnings = vtkObject.GetGlobalWarningDisplay()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkObject.GlobalWarningDisplayOff()
    try:
        window = vtkEGLRenderWindow()
        window.SetOffScreenRendering(1)
        works = bool(window.SupportsOpenGL())
        window.Finalize()
        return works
    finally:
        vtkObject.SetGlobalWarningDisplay(warnings)
        vtkLogger.SetStderrVerbosity(verbosity)


def pyvista() -> Any:
    """The pyvista module, with a working OpenGL library chosen before its first window."""
    module = require_package("pyvista")
    gl_backend()
    require_package("pyvista.plotting")  # else at the first use, where an interrupt crashes VTK's modules
    return module
