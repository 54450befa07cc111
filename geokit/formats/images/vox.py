"""MagicaVoxel's models (.vox): colors of voxels (rgba8), by a reader of geokit's own. z points up, voxels are 1 long.

Every visible model is a grid, at the place that the scene gives it; turned or repeated models are refused. Voxel
(0, 0, 0) of a file without a scene fills the unit cube at the origin. The order in which the palette is shown (IMAP)
does not change the colors.

Source:
    https://github.com/ephtracy/voxel-model, MagicaVoxel-file-format-vox.txt and its extension.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.content_limit import require_content
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError
from geokit.formats.images.image import Image, affine, reading, require_three

LARGEST_SIDE = 256
# Shades of the palette of files without one: its first colors are all of three of these, but for black, from white on;
# then come ten of red, green, blue and gray.
CUBE = (0xFF, 0xCC, 0x99, 0x66, 0x33, 0x00)
RAMP = (0xEE, 0xDD, 0xBB, 0xAA, 0x88, 0x77, 0x55, 0x44, 0x22, 0x11)
# The node that does not turn: its first row is x, the second y, none is negative.
UPRIGHT = 0b0000100


def open_images(path: Path, limit: int) -> list[Image]:
    """Read models, palette and scene; files are at most 4 bytes for each voxel that is set."""
    with reading(path):
        data = path.read_bytes()
        if data[:4] != b"VOX " or data[8:12] != b"MAIN":
            raise FileFormatError(f"{path}: is no MagicaVoxel file; check the extension")
        models: list[tuple[tuple[int, int, int], NDArray[np.uint8]]] = []
        sizes: list[tuple[int, int, int]] = []
        palette = None
        nodes: dict[int, tuple[str, bytes]] = {}
        hidden: set[int] = set()
        at = 20
        while at < len(data):
            kind, size, inner = struct.unpack_from("<4sii", data, at)
            content = data[at + 12 : at + 12 + size]
            if size < 0 or inner < 0 or len(content) < size:
                raise FileFormatError(f"{path}: ends within a chunk; get a whole copy")
            if kind == b"SIZE":
                sizes.append(require_three(path, struct.unpack_from("<3i", content)))
            elif kind == b"XYZI":
                (count,) = struct.unpack_from("<i", content)
                voxels = np.frombuffer(content, np.uint8, 4 * count, 4).reshape(-1, 4)
                shape = sizes[len(models)]
                if max(shape) > LARGEST_SIDE or (voxels[:, :3] >= np.array(shape)).any():
                    raise FileFormatError(f"{path}: has voxels outside its size {shape}; the file is damaged")
                models.append((shape, voxels))
            elif kind == b"RGBA":
                palette = np.frombuffer(content, np.uint8, 1024).reshape(256, 4)
            elif kind in (b"nTRN", b"nGRP", b"nSHP"):
                nodes[struct.unpack_from("<i", content)[0]] = kind.decode(), content
            elif kind == b"LAYR" and _dictionary(content, 4)[0].get("_hidden") == "1":
                hidden.add(struct.unpack_from("<i", content)[0])
            at += 12 + size
        if not models:
            raise FileFormatError(f"{path}: holds no model; export it again")
        if palette is None:
            palette = _default_palette()
        places = _places(nodes, hidden, len(models), path) if nodes else {}
        if nodes and len(places) < len(models):
            lost = len(models) - len(places)
            if not places:
                raise FileFormatError(
                    f"{path}: its models are hidden, or not in its scene; show them, and save it again"
                )
            warn(f"{path}: {lost} of its {len(models)} models are hidden, or not in its scene, and left out")
    shown = [number for number in range(len(models)) if number in places or not nodes]
    need = 4 * sum(x * y * z for (x, y, z), _ in (models[number] for number in shown))
    require_content(path, need, limit)
    colors = np.vstack([np.zeros((1, 4), np.uint8), palette[:255]])
    found = []
    for number in shown:
        shape, voxels = models[number]
        place, name = places.get(number, (np.zeros(3), ""))
        # A model's middle lies at its place.
        origin = place - np.array(shape) // 2 if number in places else np.zeros(3)
        found.append(
            Image(
                shape=shape,
                dtype=np.dtype(np.uint8),
                transform=affine(np.eye(3), origin + 0.5),
                slabs=partial(_whole, shape, voxels, colors),
                components=4,
                name=name or (str(number) if len(models) > 1 else ""),
            )
        )
    return found


def _whole(shape: tuple[int, int, int], voxels: NDArray[np.uint8], colors: NDArray[np.uint8]) -> Iterator[NDArray[Any]]:
    values = np.zeros((*shape, 4), np.uint8)
    values[voxels[:, 0], voxels[:, 1], voxels[:, 2]] = colors[voxels[:, 3]]
    yield values


def _default_palette() -> NDArray[np.uint8]:
    """Colors of the indices 1 to 255, and one more, of a file that has none."""
    cube = [(red, green, blue) for red in CUBE for green in CUBE for blue in CUBE][:-1]
    ramps = [
        tuple(shade * part for part in parts)
        for parts in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1))
        for shade in RAMP
    ]
    return np.array([(*color, 255) for color in (*cube, *ramps, (0, 0, 0))], np.uint8)


def _places(
    nodes: dict[int, tuple[str, bytes]], hidden: set[int], count: int, path: Path
) -> dict[int, tuple[NDArray[np.float64], str]]:
    """Place and name of each visible model, from the root of the scene; ``hidden`` are numbers of layers."""
    found: dict[int, tuple[NDArray[np.float64], str]] = {}
    waiting: list[tuple[int, NDArray[np.float64], str]] = [(0, np.zeros(3), "")]
    seen: set[int] = set()
    while waiting:
        node, place, name = waiting.pop()
        if node in seen or node not in nodes:
            raise FileFormatError(f"{path}: has a scene that repeats or lacks node {node}; export it again")
        seen.add(node)
        kind, content = nodes[node]
        facts, at = _dictionary(content, 4)
        if kind == "nTRN":
            child, _, layer, frames = struct.unpack_from("<4i", content, at)
            if facts.get("_hidden") == "1" or layer in hidden:
                continue
            if frames != 1:
                raise FileFormatError(f"{path}: holds an animation of {frames} frames; export one")
            frame, _ = _dictionary(content, at + 16)
            if int(frame.get("_r", UPRIGHT)) != UPRIGHT:
                raise FileFormatError(f"{path}: turns a model in its scene; apply that, and export it again")
            move = np.array([float(word) for word in frame.get("_t", "0 0 0").split()])
            waiting.append((child, place + move, in_one_line(facts.get("_name", ""), 100) or name))
        elif kind == "nGRP":
            (children,) = struct.unpack_from("<i", content, at)
            waiting += [(child, place, name) for child in struct.unpack_from(f"<{children}i", content, at + 4)]
        else:
            shown, model = struct.unpack_from("<2i", content, at)
            if shown != 1 or model in found or not 0 <= model < count:
                raise FileFormatError(f"{path}: repeats or lacks model {model}; export its parts as one model each")
            found[model] = place, name
    return found


def _dictionary(content: bytes, at: int) -> tuple[dict[str, str], int]:
    """Pairs of texts, and where they end."""
    (count,) = struct.unpack_from("<i", content, at)
    at += 4
    texts = []
    for _ in range(2 * count):
        (size,) = struct.unpack_from("<i", content, at)
        texts.append(content[at + 4 : at + 4 + size].decode("utf-8", "replace"))
        at += 4 + size
    return dict(zip(texts[::2], texts[1::2], strict=True)), at
