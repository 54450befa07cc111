"""Versions and build facts, for bug reports."""

from __future__ import annotations

import importlib.metadata
import platform

from geokit import native
from geokit._packages import DISTRIBUTION, PACKAGES

# Beside those of the table of packages.
_ALWAYS = ("warp-lang", "numpy", "lazy-loader")


def show_config() -> dict[str, dict[str, str]]:
    """Versions of geokit and of the packages that it uses, and how its extension was built.

    Returns:
        A dict of two: "versions" (package name to version, "" where it is not installed; also "geokit" and "python"),
        and "build": "platform", "wheel" (its tag, "" where geokit was not installed), "extension" ("yes", or why it
        cannot be loaded), and with the extension "openvdb", "nanovdb", "tbb" (versions), "compiler", "python" ("stable
        ABI" or "this version only") and "libraries" ("inside the wheel" or "of the system").

    Example:
        >>> geokit.show_config()["versions"]["geokit"]
        '0.1.0'
    """
    import geokit

    names = (*_ALWAYS, *(package.name for package in PACKAGES.values()))
    versions = {"geokit": geokit.__version__, "python": platform.python_version()}
    versions.update((name, _version(name)) for name in names)
    build = {"platform": platform.platform(), "wheel": _tag(), **native.build_facts()}
    return {"versions": versions, "build": build}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _tag() -> str:
    try:
        text = importlib.metadata.distribution(DISTRIBUTION).read_text("WHEEL") or ""
    except importlib.metadata.PackageNotFoundError:
        return ""
    tags = [line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("Tag:")]
    return " ".join(tags)
