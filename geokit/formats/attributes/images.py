"""Images of textures and their pixels, by Pillow."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileFormatError
from geokit.mesh.model.data import Texture

_KINDS = {"PNG": (b"\x89PNG", ".png"), "JPEG": (b"\xff\xd8\xff", ".jpg"), "WEBP": (b"RIFF", ".webp")}


def picture_of(texture: Texture) -> Any:
    """The image of Pillow. That it can be decoded is known, but it is not, so that :func:`as_read` has its bytes.

    Raises:
        FileFormatError: Pillow does not know it, or it is damaged.
    """
    pillow = require_package("PIL.Image")
    try:
        pillow.open(io.BytesIO(texture.data)).load()
        return pillow.open(io.BytesIO(texture.data))
    except MemoryError:
        raise
    except Exception as error:  # Pillow's readers raise errors of many kinds
        raise FileFormatError(
            f"texture {texture.name!r}: cannot be decoded ({type(error).__name__}); save it as PNG"
        ) from error


def pixels_of(texture: Texture) -> NDArray[np.uint8]:
    """Pixels (H, W, 3), or (H, W, 4) with alpha; the first row is at the top.

    Raises:
        FileFormatError: Pillow does not know the image, or it is damaged.
    """
    picture = picture_of(texture)
    has_alpha = "A" in picture.getbands() or "transparency" in picture.info
    return np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))


def pixel_count(texture: Texture) -> int:
    """Pixels of the image by its head; 0 where it cannot be decoded."""
    try:
        width, height = require_package("PIL.Image").open(io.BytesIO(texture.data)).size
    except MemoryError:
        raise
    except Exception:  # Pillow's readers raise errors of many kinds
        return 0
    return int(width) * int(height)


def png_of(pixels: NDArray[np.uint8]) -> bytes:
    """A PNG of pixels (H, W), (H, W, 3) or (H, W, 4)."""
    found = io.BytesIO()
    pillow = require_package("PIL.Image")
    pillow.fromarray(np.ascontiguousarray(pixels[..., 0] if pixels.shape[2:] == (1,) else pixels)).save(found, "PNG")
    return found.getvalue()


def as_read(picture: Any) -> tuple[bytes, str]:
    """The file of an image of Pillow, and its extension: the bytes it was read from until it is decoded, else a PNG."""
    # Copies have neither.
    stream = getattr(picture, "fp", None)
    magic, end = _KINDS.get(getattr(picture, "format", None) or "", (b"", ""))
    if stream is not None and magic:
        place = stream.tell()
        stream.seek(0)
        data = stream.read()
        stream.seek(place)
        if data.startswith(magic):
            return data, end
    mode = picture.mode if picture.mode in ("L", "RGB", "RGBA", "P", "1", "LA", "I;16") else "RGBA"
    found = io.BytesIO()
    (picture if mode == picture.mode else picture.convert(mode)).save(found, "PNG")
    return found.getvalue(), ".png"
