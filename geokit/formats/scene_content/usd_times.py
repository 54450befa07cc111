"""When a USD stage is read: the default time, or the first sample of what has only samples.

usd-core is imported in the functions: reader processes wait for this import.
"""

from __future__ import annotations

from typing import Any

__all__ = ["is_animated", "time_of", "value_of"]


def time_of(*attributes: Any) -> Any:
    """The default time, or the earliest where one of the attributes has samples and no default.

    ``Get()`` would give the fallback of the schema there, such as a radius of 1.
    """
    from pxr import Usd

    default = Usd.TimeCode.Default()
    for attribute in attributes:
        unset = (Usd.ResolveInfoSourceNone, Usd.ResolveInfoSourceFallback)
        if (
            attribute.GetResolveInfo(default).GetSource() in unset
            and attribute.GetResolveInfo().GetSource() not in unset
        ):
            return Usd.TimeCode.EarliestTime()
    return default


def value_of(attribute: Any) -> Any:
    """The value at the default time, or the first sample; None if there is none."""
    return attribute.Get(time_of(attribute))


def is_animated(prim: Any) -> bool:
    """Whether samples change a prim's shape, its place or what moves its bones."""
    from pxr import UsdGeom, UsdSkel

    kinds = (UsdGeom.Boundable, UsdGeom.Xform, UsdSkel.Animation)
    return any(map(prim.IsA, kinds)) and any(one.ValueMightBeTimeVarying() for one in prim.GetAuthoredAttributes())
