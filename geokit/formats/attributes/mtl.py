"""Material libraries (.mtl) of .obj files: names, base colors, and the images of the base colors."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from geokit.errors import FileAccessError
from geokit.formats.file_content.body import FileMaterial
from geokit.formats.file_content.references import LONGEST, require_inside
from geokit.mesh.model.data import Material

# Larger files are no material libraries and no images, and memory must not end for a name in a file.
LARGEST_FILE = 1 << 30
# Options of a texture, which stand before its name, and the most numbers or words that follow each.
_OPTIONS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2} | dict.fromkeys(
    ("-blendu", "-blendv", "-boost", "-texres", "-clamp", "-bm", "-imfchan", "-type", "-cc"), 1
)
_OTHER_TEXTURES = ("map_", "bump", "disp", "decal", "refl", "norm")


def read_libraries(
    names: Iterable[str], used: set[str], path: Path, folders: Sequence[Path], notes: list[str]
) -> dict[str, FileMaterial]:
    """The used materials by name.

    Args:
        names: What stands behind ``mtllib``; each may be several files.
        used: Names of materials.
        path: The .obj file.
        folders: Folders besides its own in which files may lie.
        notes: Gets a line for each file that is not read, and for further textures.
    """
    found: dict[str, FileMaterial] = {}
    for listed in names:
        # The names of several files are separated by spaces, which one name may contain as well.
        for name in [listed] if os.path.isfile(path.parent / listed) else listed.split():
            content = _content(name, path.parent, path, folders, notes, "materials have only their names")
            if content is not None:
                text, base = content[1].decode("utf-8", "replace"), content[0].parent
                found.update(_parsed(text, used - found.keys(), base, path, folders, notes))
    return found


def _content(
    name: str, base: Path, path: Path, folders: Sequence[Path], notes: list[str], loss: str
) -> tuple[Path, bytes] | None:
    """The place and the bytes of a file that another one names; a note if it is not read."""
    shown = repr(name[:LONGEST])
    try:
        found = require_inside(name, base / name.replace("\\", "/"), path, folders)
        if found.is_file() and found.stat().st_size <= LARGEST_FILE:
            return found, found.read_bytes()
        notes.append(f"{shown} is {'too large' if found.is_file() else 'missing'}: {loss}")
    except FileAccessError as error:
        notes.append(f"{str(error).removeprefix(f'{path}: ')} ({loss})")
    except OSError as error:
        notes.append(f"{shown} cannot be read ({error.strerror}): {loss}")
    return None


def image_content(name: str, path: Path, folders: Sequence[Path], notes: list[str]) -> bytes:
    """The bytes of an image that a file names; b"" and a note if it is not read."""
    content = _content(name, path.parent, path, folders, notes, "its texture is left out")
    return b"" if content is None else content[1]


def _parsed(
    text: str, used: set[str], base: Path, path: Path, folders: Sequence[Path], notes: list[str]
) -> dict[str, FileMaterial]:
    found: dict[str, FileMaterial] = {}
    images: dict[str, bytes] = {}
    others: dict[str, None] = {}
    name = ""
    for line in text.replace("\\\n", " ").splitlines():
        kind, rest = [*line.strip().split(None, 1), "", ""][:2]
        kind = kind.lower()
        if kind == "newmtl":
            name = rest
            if name in used:
                found[name] = FileMaterial(name)
        if name not in found or not rest:
            continue
        material = found[name]
        red, green, blue, alpha = material.color or (1.0, 1.0, 1.0, 1.0)
        if kind == "kd" and len(numbers := _numbers(rest)) in (1, 3):
            found[name] = material._replace(color=(*(numbers * 3)[:3], alpha))
        elif kind in ("d", "tr") and len(numbers := _numbers(rest)) == 1:
            opacity = numbers[0] if kind == "d" else 1.0 - numbers[0]
            # Nobody exports what cannot be seen; exporters that take Tr for d do write "Tr 1".
            found[name] = material._replace(color=(red, green, blue, opacity or 1.0))
        elif kind == "map_kd":
            image = _image_name(rest)
            if image not in images:
                content = _content(image, base, path, folders, notes, "its texture is left out")
                images[image] = b"" if content is None else content[1]
            plain = PurePosixPath(image.replace("\\", "/")).name
            found[name] = material._replace(texture_name=plain, texture=images[image])
        elif kind.startswith(_OTHER_TEXTURES):
            others[kind] = None
    if others:
        notes.append(f"of its textures only those of the base color are read, not {', '.join(others)}")
    return found


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _image_name(text: str) -> str:
    """The name behind the options; it may contain spaces."""
    words = text.split(" ")
    while words and words[0] in _OPTIONS:
        most, words = _OPTIONS[words[0]], words[1:]
        taken = 0
        while taken < most and len(words) > 1 and (most == 1 or _numbers(words[0])):
            taken, words = taken + 1, words[1:]
    return " ".join(words).strip()


def image_names(library: Path) -> set[str]:
    """Names of the images of base colors in a library; none if it cannot be read."""
    try:
        if not library.is_file() or library.stat().st_size > LARGEST_FILE:
            return set()
        lines = library.read_text("utf-8", "replace").splitlines()
    except (OSError, ValueError):
        return set()
    words = [[*line.strip().split(None, 1), "", ""] for line in lines]
    return {_image_name(rest) for kind, rest, *_ in words if kind.lower() == "map_kd"}


def library_name(stem: str) -> str:
    """The name of the library beside an .obj file; some readers take spaces for the end of it."""
    return f"{_word(stem)}.mtl"


def plain_names(materials: Sequence[Material]) -> list[str]:
    """Different names without spaces."""
    names: list[str] = []
    for material in materials:
        names.append(_free(_word(material.name) or "material", names))
    return names


def write_library(materials: Sequence[Material], stem: str) -> dict[str, bytes]:
    """The library and its images as files by name; none if there are no materials.

    Images are called after the .obj file, so that they replace none of another.
    """
    names, files = image_files(materials, stem)
    lines = ["# by geokit"]
    for name, material, image in zip(plain_names(materials), materials, names, strict=True):
        lines.append(f"newmtl {name}")
        if material.color is not None:
            red, green, blue, alpha = (repr(float(channel)) for channel in material.color)
            alpha = "1.0" if material.alpha_cutoff == 0.0 else alpha
            lines += [f"Kd {red} {green} {blue}", f"d {alpha}"]
        if image:
            lines.append(f"map_Kd {image}")
    return {**files, library_name(stem): ("\n".join(lines) + "\n").encode()} if materials else {}


def image_files(materials: Sequence[Material], stem: str) -> tuple[list[str], dict[str, bytes]]:
    """The image of each material by its file's name, "" if it has none, and the files by name."""
    names: list[str] = []
    files: dict[str, bytes] = {}
    for material in materials:
        names.append("")
        if material.texture is not None:
            image = _word(PurePosixPath(material.texture.name.replace("\\", "/")).name) or "texture"
            image = image if image.startswith(_word(stem)) else f"{_word(stem)}_{image}"
            same = [known for known, content in files.items() if known == image and content == material.texture.data]
            names[-1] = same[0] if same else _free(image, files)
            files[names[-1]] = material.texture.data
    return names, files


def _word(text: str) -> str:
    """Text without spaces, and without the bytes of names that are no UTF-8."""
    plain = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace").replace("\ufffd", "_")
    return "_".join(plain.split())


def _free(name: str, taken: Iterable[str]) -> str:
    known, path, number = set(taken), PurePosixPath(name), 1
    while name in known:
        number += 1
        name = f"{path.stem}_{number}{path.suffix}"
    return name
