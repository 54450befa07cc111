"""Entries of a glTF file's JSON. Damaged files hold anything: what is not of the kind asked for counts as absent."""

from __future__ import annotations

from typing import Any

__all__ = ["entry_of", "object_of", "objects", "primitives_of"]


def object_of(value: Any) -> dict[str, Any]:
    """The object, or an empty one."""
    return value if isinstance(value, dict) else {}


def objects(value: Any, kind: type = dict) -> list[Any]:
    """The entries of a list that are objects, or of another kind."""
    return [entry for entry in value if isinstance(entry, kind)] if isinstance(value, list) else []


def entry_of(tree: dict[str, Any], name: str, index: Any) -> dict[str, Any] | None:
    """The object of that number in a list of the file; None if there is none."""
    found = tree.get(name)
    if not isinstance(found, list) or not isinstance(index, int) or not 0 <= index < len(found):
        return None
    return found[index] if isinstance(found[index], dict) else None


def primitives_of(tree: dict[str, Any]) -> list[dict[str, Any]]:
    """The primitives of all meshes."""
    return [part for mesh in objects(tree.get("meshes")) for part in objects(mesh.get("primitives"))]
