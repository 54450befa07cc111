"""Geometry on sparse volumes and meshes: closest points, rays, signed distance fields and neighbors."""

import lazy_loader

from geokit._drawing import drawn_by

__version__ = "0.1.0"

# __init__.pyi lists the public names; each is imported on first use.
_found, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*__all__, "__version__"]


def __getattr__(name: str) -> object:
    if name in ("load", "save"):
        # What comes of a file would depend on its name, and no type checker would know.
        where = ", ".join(f"geokit.{door}.{name}" for door in ("mesh", "volume", "points"))
        raise AttributeError(f"geokit has no {name}; use one of {where}")
    return _found(name)


def _picture(thing: object) -> str:
    from geokit.render._notebook import notebook_html

    return notebook_html(thing)


def _show(thing: object, path: object) -> object:
    from geokit.render._view import show

    return show(thing, path)  # type: ignore[arg-type]


drawn_by(_picture, _show)
