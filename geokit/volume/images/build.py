"""A sparse volume of a dense one that comes slab after slab: the dense array is never whole in memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.content_limit import require_content
from geokit.core.memory import available_memory
from geokit.errors import FileFormatError, InputError
from geokit.formats.images.image import Image, affine
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.header import checked_transform, info_of, voxel_size_of
from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.nanovdb.provenance import SPACE, UNIT
from geokit.volume.nanovdb.types import GRID_CLASSES, WHOLE_TYPES, WHOLE_VECTOR_TYPES
from geokit.volume.tree.dense_tiles import BYTES_PER_LEAF, VOXELS_AT_A_TIME, DenseTiles, mark_inside
from geokit.volume.tree.dense_typed import DenseRule, background_of, layout_for, tree_of_dense
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.grid_head import GridHead, checked_head
from geokit.volume.tree.typed_tree import TypedTree, tree_of_leaves
from geokit.volume.tree.typed_writer import build_grid

# A value is taken for the background if more than this share of the first slice's border has it.
LEAST_SHARE = 0.5
INT32 = np.iinfo(np.int32)
# Copies of a block, at most, while leaves are made of it: as read, joined, in the order and type of leaves, and masks.
COPIES = 4
# Bytes that NumPy counts.
LARGEST = 1 << 62


@dataclass(frozen=True)
class _Plan:
    """What becomes of an image: layout, class, name, first index and transform of the grid."""

    layout: GridLayout
    grid_class: str
    name: str
    start: NDArray[np.int64]
    transform: NDArray[np.float64]


def info_of_image(image: Image, path: Path) -> GridInfo:
    """The description of an image without its voxels: the box is that of the array, counts are unknown.

    Raises:
        FileFormatError: No grid has such a place or such values.
    """
    plan = _plan(image, path)
    background = _stated(image)
    return GridInfo(
        name=plan.name,
        grid_type=plan.layout.name,
        grid_class=plan.grid_class,
        transform=plan.transform,
        voxel_size=voxel_size_of(plan.transform),
        background=background,
        active_voxel_count=None,
        index_bounds=np.stack([plan.start, plan.start + image.shape - 1]),
        byte_count=image.byte_count,
        metadata=_metadata(image),
    )


def volume_of_image(
    image: Image,
    path: Path,
    *,
    background: Any = None,
    tolerance: float = 0.0,
    grid_type: str | None = None,
    limit: int,
) -> SparseVolume:
    """Build the grid of an image.

    Args:
        image: The dense volume.
        path: Its file, for messages.
        background: As of ``from_dense``; None for what the file says, else the negative value that more than half of
            the border of its first slice has, else 0.
        tolerance: As of ``from_dense``.
        grid_type: Type of the grid; None for that of the values.
        limit: Largest size [bytes] of the decompressed voxels, and of the copies of a block of them; those of
            uncompressed files are bounded by the file.
    Raises:
        FileFormatError: No grid holds such values, or they have no place.
        InputError: The grid's type does not exist, or does not hold such voxels or the background.
        DeviceMemoryError: The voxels are more than the limit, or the grid does not fit into memory.
    """
    if image.packed:
        require_content(path, image.byte_count, limit)
    plan = _plan(image, path, grid_type)
    # A page, or eight, may be all of the file. Blocks of the usual size are no matter.
    length = image.shape[image.axis]
    share = min(_thickness(image, plan), length) / length
    if image.packed and share * math.prod(image.shape) > VOXELS_AT_A_TIME:
        require_content(path, int(COPIES * share * image.byte_count), limit)
    blocks = _counted(_blocks(image, path, plan), path)
    first = next(blocks)
    layout, level_set = plan.layout, plan.grid_class == "level set"
    try:
        stored = background_of(_stated(image) if background is None else background, layout)
    except InputError:
        if background is not None:
            raise
        stored = background_of(_border(first[0].take(0, axis=image.axis)), layout)
    outside: Any = float(stored) if layout.name == "float" else stored
    if level_set and (stored.ndim or outside <= 0.0):
        plan, level_set = replace(plan, grid_class="unknown"), False
    try:
        head = checked_head(layout.name, outside, outside, plan.transform, plan.name, plan.grid_class)
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from None
    rule = DenseRule(layout, stored, tolerance, level_set)
    try:
        build = _float_grid if layout.name == "float" else _typed_grid
        buffer = build(_all(first, blocks, stored), plan, rule, head, path)
    except InputError as error:
        # What from_dense says of an argument is said here of the file.
        raise FileFormatError(f"{path}: {str(error).removeprefix('values: ')}") from None
    return SparseVolume(buffer, replace(info_of(buffer), metadata=_metadata(image)))


def _plan(image: Image, path: Path, grid_type: str | None = None) -> _Plan:
    note = image.note
    grid_class = note.get("class") if note.get("class") in GRID_CLASSES else "unknown"
    start = _first_index(note)
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # of numbers that are not finite, or hardly
            transform = checked_transform(image.transform @ affine(np.eye(3), -start.astype(np.float64)))
    except InputError:
        text = np.array2string(image.transform[:3], separator=",").replace("\n", "")
        raise FileFormatError(f"{path}: the transform of its voxels, {text}, is not finite and invertible") from None
    if (start + image.shape).max() > INT32.max or start.min() < INT32.min:
        raise FileFormatError(f"{path}: has {image.shape} voxels; indices are 32-bit numbers")
    if image.byte_count > LARGEST:
        raise FileFormatError(f"{path}: declares {image.shape} voxels, which no memory holds; the file is damaged")
    like = np.broadcast_to(
        np.zeros((), image.dtype.newbyteorder("=")),
        (*image.shape, image.components) if image.components > 1 else image.shape,
    )
    layout = None
    if grid_type is not None:
        layout_for(like, grid_type, "unknown")  # what it does not hold is an error of the argument
    known = note.get("type") if grid_type is None else grid_type
    for kind, wanted in ((known, grid_class), (_kind(image), grid_class), (_kind(image), "unknown")):
        if layout is None and (kind is None or isinstance(kind, str)):
            try:
                layout, grid_class = layout_for(like, kind, str(wanted)), wanted
            except InputError:
                continue
    if layout is None:
        raise FileFormatError(f"{path}: no grid has {image.components} {image.dtype} in a voxel; convert the values")
    name = image.name or (note["name"] if isinstance(note.get("name"), str) else "")
    return _Plan(layout, str(grid_class), name.replace("\0", ""), start, transform)


def _kind(image: Image) -> str | None:
    """The type of grid for whole numbers that no grid has, such as uint64; None for that of the array."""
    kind, count = image.dtype.str[1:], image.components
    if kind[0] not in "iu" or (kind in WHOLE_TYPES if count == 1 else (kind, count) in WHOLE_VECTOR_TYPES):
        return None
    return "int64" if count == 1 else f"vec{count}f"


def _first_index(note: Any) -> NDArray[np.int64]:
    found = note.get("origin", (0, 0, 0))
    if (
        not isinstance(found, (list, tuple))
        or len(found) != 3
        or not all(isinstance(at, int) and abs(at) <= INT32.max for at in found)
    ):
        return np.zeros(3, np.int64)
    return np.array(found, np.int64)


def _metadata(image: Image) -> Any:
    return MappingProxyType({key: text for key, text in ((UNIT, image.unit), (SPACE, image.space)) if text})


def _thickness(image: Image, plan: _Plan) -> int:
    """Planes of a block, but for the first, which ends where a leaf does."""
    length = image.shape[image.axis]
    # In a level set inner tiles need the nodes of leaves that may lie in another block.
    if plan.grid_class == "level set" and plan.layout.name != "float":
        return length + 8
    plane = max(1, math.prod(image.shape) // length)
    return 8 * max(1, VOXELS_AT_A_TIME // (8 * plane))


def _blocks(image: Image, path: Path, plan: _Plan) -> Iterator[tuple[NDArray[Any], NDArray[np.int64]]]:
    """The voxels in blocks that begin where leaves do, with their first index."""
    axis, length = image.axis, image.shape[image.axis]
    start, thick = plan.start, _thickness(image, plan)
    parts: list[NDArray[Any]] = []
    at, have, goal = 0, 0, thick - int(start[axis]) % 8
    for slab in image.slabs():
        rest = slab
        while rest.shape[axis]:
            part, rest = np.split(rest, [goal - have], axis=axis)
            parts.append(part)
            have += part.shape[axis]
            if have == goal or at + have == length:
                place = start.copy()
                place[axis] += at
                yield (parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)), place
                at, parts, have, goal = at + have, [], 0, thick
    if at != length:
        raise FileFormatError(f"{path}: holds {at} of its {length} slices; get a whole copy")


def _counted(
    blocks: Iterator[tuple[NDArray[Any], NDArray[np.int64]]], path: Path
) -> Iterator[tuple[NDArray[Any], NDArray[np.int64]]]:
    """The same blocks, and a warning of values that are not finite: they become background."""
    count = 0
    for block, place in blocks:
        if block.dtype.kind == "f":
            count += block.size - int(np.count_nonzero(np.isfinite(block)))
        yield block, place
    if count:
        warn(f"{path}: {count} values are not finite and become the background")


def _all(
    first: tuple[NDArray[Any], NDArray[np.int64]],
    rest: Iterator[tuple[NDArray[Any], NDArray[np.int64]]],
    background: NDArray[Any],
) -> Iterator[tuple[NDArray[Any], NDArray[np.int64]]]:
    """All blocks, without values that are not finite."""

    def finite(block: NDArray[Any]) -> NDArray[Any]:
        if block.dtype.kind != "f" or (known := np.isfinite(block)).all():
            return block
        return np.where(known, block, background.astype(block.dtype))

    yield finite(first[0]), first[1]
    yield from ((finite(block), place) for block, place in rest)


def _stated(image: Image) -> Any:
    """The background that the file states; None if it does not."""
    found = image.note.get("background", image.background)
    numbers = found if isinstance(found, list) else [found]
    if not all(isinstance(one, (int, float, np.generic)) and np.isfinite(one) for one in numbers):
        return None
    return tuple(found) if isinstance(found, list) else found


def _border(face: NDArray[Any]) -> Any:
    """The negative value that more than half of the border of a slice (A, B) has, as air in CT; 0 if there is none."""
    rows = np.concatenate([face[0], face[-1], face[:, 0], face[:, -1]])
    values, counts = np.unique(rows.reshape(len(rows), -1), axis=0, return_counts=True)
    most = int(counts.argmax())
    # Positive ones may be those of a body that fills the array.
    if face.ndim > 2 or counts[most] <= LEAST_SHARE * len(rows) or not -np.inf < values[most, 0] < 0:
        return 0
    return values[most, 0]


def _float_grid(
    blocks: Iterable[tuple[NDArray[Any], NDArray[np.int64]]], plan: _Plan, rule: DenseRule, head: GridHead, path: Path
) -> NDArray[np.uint8]:
    found: list[tuple[NDArray[Any], ...]] = [
        (np.empty((0, 3), np.int64), np.empty((0, 512), np.float32), np.empty((0, 64), np.uint8))
    ]
    hollow = [np.empty((0, 3), np.int64)]
    count = 0
    for block, place in blocks:
        with np.errstate(over="ignore"):
            dense = np.ascontiguousarray(block, np.float32)
        if not np.isfinite(dense).all():
            raise FileFormatError(f"{path}: holds numbers beyond float32; scale them")
        tiles = DenseTiles(dense, place, float(rule.background), rule.tolerance, rule.level_set)
        leaves, inside = tiles.sort_out()
        count += len(leaves)
        _require_room(path, count, len(leaves), BYTES_PER_LEAF)
        found.append((leaves, *tiles.contents(leaves)))
        hollow.append(inside)
    leaves, values, masks = (np.concatenate(parts) for parts in zip(*found, strict=True))
    found.clear()
    buffer = build_leaves(head, leaves.astype(np.int32), values, masks, signed=False)
    mark_inside(buffer, np.concatenate(hollow), float(rule.background))
    return buffer


def _typed_grid(
    blocks: Iterable[tuple[NDArray[Any], NDArray[np.int64]]], plan: _Plan, rule: DenseRule, head: GridHead, path: Path
) -> NDArray[np.uint8]:
    trees: list[TypedTree] = []
    per_leaf = 2 * (512 * rule.layout.background.itemsize + 256)
    count = 0
    for block, place in blocks:
        trees.append(tree_of_dense(block, place, rule))
        count += len(trees[-1].origins)
        _require_room(path, count, len(trees[-1].origins), per_leaf)
    if len(trees) == 1:
        return build_grid(trees[0], head)
    origins, masks, values = (
        np.concatenate([getattr(tree, name) for tree in trees]) for name in ("origins", "masks", "values")
    )
    trees.clear()
    return build_grid(tree_of_leaves(rule.layout, rule.background, origins, masks, values), head)


def _require_room(path: Path, count: int, more: int, per_leaf: int) -> None:
    """Refuse to go on where memory would run out: leaves are held, joined, and written to the grid."""
    remedy = "name its background, or a tolerance around it (--background, --background-tolerance)"
    what = f"{path}: {count} leaves of its first slices need"
    available_memory.require_room((count + more) * per_leaf, what, remedy)
