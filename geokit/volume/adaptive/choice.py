"""Compares several levels of voxels with one voxel size: which keeps a tolerance with fewer bytes?"""

from __future__ import annotations

import math
from typing import NamedTuple

from geokit.errors import DeviceMemoryError
from geokit.volume.adaptive.build import build_band_level
from geokit.volume.adaptive.level_sizes import ORDERS, Choice, choose
from geokit.volume.adaptive.storage import Storage
from geokit.volume.tolerance.search import Search, Setting, quickest

# Several levels must promise at most this share of the bytes of one voxel size: they are slower to read.
WORTH_LEVELS = 0.95
# Bytes of one voxel size are predicted to a quarter. Levels below CLOSE of the prediction are surely the smaller, those
# above FAR of it the larger; between them the grid of one voxel size must be made first.
CLOSE, FAR = 0.75, 1.25
# Counted bytes of a band over those of its grid: 1.06 on the bracket.
OVERCOUNT = 1.1


class LevelsOrOne(NamedTuple):
    """The best single voxel size, and the levels that may take fewer bytes.

    Attributes:
        one: The setting of one voxel size of least memory; None if none keeps the tolerance.
        levels: Several levels; their ``tree`` is None if all take clearly more than ``one``.
    """

    one: Setting | None
    levels: Choice


def levels_or_one(search: Search, level_limit: int) -> LevelsOrOne:
    """The best voxel size, and the levels that keep the same tolerance with about as many bytes or fewer.

    Args:
        search: The search for one voxel size, which holds the tolerance, the surface, and all orders and codecs to try.
        level_limit: Most levels.
    """
    try:
        one = next(quickest(search.settings()), None)
    except DeviceMemoryError:
        one = None
    if one is None:
        return LevelsOrOne(None, levels_of(search, level_limit))
    return LevelsOrOne(one, fewer_bytes(search, level_limit, FAR * one.byte_count))


def fewer_bytes(search: Search, level_limit: int, most_bytes: float) -> Choice:
    """Levels that take less than ``most_bytes``; without a tree if there are none."""
    if level_limit == 1:
        return Choice(None, math.inf)
    try:
        found = levels_of(search, level_limit, OVERCOUNT * most_bytes)
    except DeviceMemoryError:
        return Choice(None, math.inf)
    if found.tree is None or not math.isfinite(found.byte_count):
        return Choice(None, math.inf)
    # Bands are counted by tiles, of which some hold no voxel, so level 0 is made to know its bytes.
    tree = found.tree
    byte_count = build_band_level(tree.lattice, tree.storage, "").info.byte_count
    byte_count += sum(placement.byte_count for placement in tree.placements())
    return Choice(tree, byte_count) if byte_count <= most_bytes else Choice(None, math.inf)


def levels_of(search: Search, level_limit: int, most_bytes: float = math.inf) -> Choice:
    """The levels of least memory within the tolerance of a search.

    Raises:
        DeviceMemoryError: There are more cells than memory can hold.
    """
    orders = {option.order for option in search.options}
    codecs = {option.codec for option in search.options}
    codec = next(iter(codecs)) if len(codecs) == 1 else None
    tried = [order for order in ORDERS if order in orders] or sorted(orders)
    storages = [Storage(order, codec, search.tolerance, search.zone.within) for order in tried]
    return choose(search.memory.surface, search.sign_method, storages, level_limit, most_bytes)
