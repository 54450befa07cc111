"""Searches the setting of least memory within a tolerance: voxel size, half width, interpolation order and codec.

Errors are measured, not derived: the interpolants of all orders are evaluated from exact voxels at points of the zone,
for voxel sizes from coarse to fine. The worst points of a size are moved a little and used again at the next size.
Edges and thin parts have few of the points and most of the error; this way they are seen at every size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.blocks.chunked_queries import Progress
from geokit.volume.nanovdb.types import FIXED_BITS, QUANTIZED
from geokit.volume.tolerance.band_memory import BandCounts, BandMemory
from geokit.volume.tolerance.interpolation_errors import REACH, interpolation_errors, quantization_step, stencils_of
from geokit.volume.tolerance.zone import Zone

ORDERS = (1, 2, 3)
# From the quickest to the slowest to read; a slower one is tried because it may be smaller.
CODECS = ("float", *reversed(list(FIXED_BITS)), *(name for name in QUANTIZED if name not in FIXED_BITS))
# Bits of a leaf's voxels in "fpn".
LEAF_BITS = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
# Largest change of a voxel by "fpn", as shares of the tolerance; a trade-off between more bits and more voxels.
FPN_SHARES = (0.5, 0.3, 0.15)
# AIM is the share of the tolerance that is aimed at. Each field that misses the tolerance multiplies it by CAUTION, but
# the first FREE_MISSES do not: where a lattice suits a mesh by chance, the next best setting may be far off.
AIM, CAUTION, FREE_MISSES = 0.99, 0.95, 6
# Voxels that are evaluated per size: half a second on a CPU.
VOXELS_PER_SIZE = 500_000
# For each order, one of TAKEN points counts as worst; each is moved MOVES times for the next size.
TAKEN, MOVES = 25, 3
# Rounds per size: the first at the points, the others at AROUND new points around each of the worst.
ROUNDS, AROUND = 3, 4
# Voxels along the longest side at the start of the search.
FIRST_RESOLUTION = 4.0
# Ratio of a voxel size to the one before: STEP near the aim, LONGEST_STEP far from it.
STEP, LONGEST_STEP = 0.5**0.5, 0.2
# Most sizes that are tried before the search gives up, from 4 voxels to a million.
MOST_SIZES = 36
# A voxel size this near to one that misses the aim is not refined further: 7 % are 14 % of memory.
CLOSE = 0.93
# Most refinements between known sizes; more gain nothing. One that cannot reduce memory to this share is skipped.
MOST_LOOKS, WORTH = 12, 0.97
# Number of best settings that are tried with coarser voxels, and the scan: from 1.35 to 1.0 times the voxel size, in 12
# steps.
SCANNED, SCAN = 2, (1.35, 1.0, 12)
# If voxels finer by STUCK_OVER do not bring errors below this share, finer voxels will not either.
STUCK, STUCK_OVER = 0.9, 1.9
# Settings within this ratio of memory are ordered by how fast they are to read.
SAME_MEMORY = 1.05


# Searches evaluate errors 35 to 230 times: the percent said halves what is left after so many, and ends there.
HALF_DONE, LAST_PERCENT = 40, 95


class Option(NamedTuple):
    """Order and codec; ``share`` is the share of the tolerance by which "fpn" may change a voxel, else 0."""

    order: int
    codec: str
    share: float = 0.0


class Setting(NamedTuple):
    """An option at the largest voxel size that keeps the tolerance, and its cost.

    Attributes:
        option: Order and codec.
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on either side [voxels].
        error: Largest error found [world].
        counts: Predicted nodes of the grid.
        bits: Mean bits per voxel, for "fpn".
    """

    option: Option
    voxel_size: float
    half_width: float
    error: float
    counts: BandCounts
    bits: float

    @property
    def byte_count(self) -> float:
        return self.counts.bytes_of(self.option.codec, self.bits)


@dataclass
class _Level:
    """Largest error of each option at one voxel size."""

    voxel_size: float
    errors: dict[Option, float]


def options_of(orders: Sequence[int], codecs: Sequence[str]) -> list[Option]:
    """All options, the fastest to read first."""
    options = [Option(order, codec) for order in orders for codec in codecs if codec != "fpn"]
    if "fpn" in codecs:
        options += [Option(order, "fpn", share) for order in orders for share in FPN_SHARES]
    return options


@dataclass
class Search:
    """Searches the setting of least memory.

    Attributes:
        zone: The zone in which the tolerance holds, with its exact field.
        memory: Predicts the nodes of bands.
        tolerance: Largest error [world].
        options: The options to choose from.
        most_bytes: Most memory while the grid is built.
        leaf_ranges: Returns, for a half width in voxels, the value range of each of some leaves as a share of the
            band's range.
        half_width: Half width of the band [voxels], if the caller fixed it.
        sign: Sign method from the caller.
        sign_method: Sign method in use.
        seed: Random seed of the points.
        levels: The voxel sizes tried so far, the largest first.
        is_limited_by_memory: Whether finer voxels were left out because they do not fit.
        progress: Called as ``progress(percent, 100)`` while errors are evaluated.
    """

    zone: Zone
    memory: BandMemory
    tolerance: float
    options: list[Option]
    most_bytes: float
    leaf_ranges: Callable[[float], NDArray[np.float64]]
    half_width: float | None = None
    sign: str = "auto"
    sign_method: str = "none"
    seed: int = 0
    levels: list[_Level] = field(default_factory=list)
    is_limited_by_memory: bool = False
    progress: Progress | None = None
    _evaluations: int = 0
    _missed: int = 0
    _shares: dict[float, NDArray[np.float64]] = field(default_factory=dict)
    _told: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    _worst: tuple[NDArray[np.float64], float] = field(default_factory=lambda: (np.empty((0, 3)), 0.0))

    def width_of(self, option: Option, voxel_size: float) -> float:
        """Half width [voxels] that the interpolant needs in the zone."""
        return self.half_width or max(1.0, REACH[option.order] + self.zone.within / voxel_size)

    def settings(self) -> list[Setting]:
        """The options that keep the tolerance, each at its largest known voxel size, least memory first.

        Options that cannot compete are left out.
        """
        self._descend()
        for _ in range(MOST_LOOKS):
            found = sorted((s for o in self.options if (s := self._setting(o))), key=lambda s: s.byte_count)
            # Options that might beat the smallest setting, if a voxel size between known ones keeps the tolerance.
            hopes = [
                (hope, setting.option)
                for setting in found
                if not self._is_close(setting)
                and (hope := self._cost(setting.option, self._between(setting.option))) < WORTH * found[0].byte_count
            ]
            if not hopes:
                break
            _, first = min(hopes)
            self._look(self._between(first), [option for _, option in hopes])
        for setting in found[:SCANNED]:
            self._scan(setting)
        return sorted((s for o in self.options if (s := self._setting(o))), key=lambda s: s.byte_count)

    @property
    def aim(self) -> float:
        """Largest error [world] of a setting in the search; below the tolerance, since other points may be worse."""
        return AIM * CAUTION ** max(0, self._missed - FREE_MISSES) * self.tolerance

    def correct(self, setting: Setting, error: float, worst: NDArray[np.float64]) -> None:
        """Record that a check of a setting found a larger error, and search more carefully from now on.

        Args:
            setting: The checked setting.
            error: Its largest error [world].
            worst: Points with its largest errors [world], shape (N, 3); all sizes are tested there from now on.
        """
        self._missed += 1
        self._told = np.concatenate([self._told, worst])
        random = np.random.default_rng(self._missed)
        for level in self.levels:
            if level.voxel_size == setting.voxel_size:
                level.errors[setting.option] = max(error, level.errors.get(setting.option, 0.0))
            options = [option for option, known in level.errors.items() if known <= self.aim]
            if not options:
                continue
            step = 0.5 * level.voxel_size
            near = self.zone.kept(worst), self.zone.near(self.zone.moved(worst, step, random), step, random)
            points, exact = (np.concatenate(part) for part in zip(*near, strict=True))
            found = self._errors(points, exact, level.voxel_size, options)
            level.errors.update({o: max(level.errors[o], float(found[o].max(initial=0.0))) for o in options})

    def _scan(self, setting: Setting) -> None:
        """Try coarser voxels, whose lattice may suit the mesh by chance: faces and edges on it have no error."""
        option, aim = setting.option, self.aim
        for size in setting.voxel_size * np.geomspace(*SCAN)[:-1]:
            # Most sizes fail at the few points that failed before, so these are tested first.
            points, exact = self.zone.kept(self._worst[0])
            if float(self._errors(points, exact, size, [option])[option].max()) > aim:
                continue
            # A size that suits one codec may suit a smaller one.
            if self._look(size, [o for o in self.options if o.order == option.order]).errors[option] <= aim:
                return

    def reachable(self) -> float:
        """Least tolerance [world] that any option can keep in the available memory."""
        errors = [
            min(error for option, error in level.errors.items() if self.fits(option, level.voxel_size))
            for level in self.levels
            if any(self.fits(option, level.voxel_size) for option in level.errors)
        ]
        return min(errors, default=math.inf)

    @property
    def is_stuck(self) -> bool:
        """Whether finer voxels no longer reduce errors."""
        finest = self.levels[-1]
        coarser = [level for level in self.levels if level.voxel_size > STUCK_OVER * finest.voxel_size]
        shared = [option for option in finest.errors if coarser and option in coarser[-1].errors]
        return bool(shared) and all(finest.errors[o] > STUCK * coarser[-1].errors[o] for o in shared)

    def _descend(self) -> None:
        """Try finer and finer voxels until every option keeps the tolerance or cannot be the best."""
        size = self.zone.longest / FIRST_RESOLUTION
        if self.levels:
            size = STEP * self.levels[-1].voxel_size
        settings = [s for option in self.options if (s := self._setting(option))]
        best = min((setting.byte_count for setting in settings), default=math.inf)
        kept = {setting.option for setting in settings}
        waiting = [option for option in self.options if option not in kept]
        for _ in range(MOST_SIZES):
            waiting = [o for o in waiting if self._cost(o, size) < best]
            fitting = [option for option in waiting if self.fits(option, size)]
            self.is_limited_by_memory |= len(fitting) < len(waiting)
            waiting = fitting
            if not waiting:
                return
            errors = self._look(size, waiting).errors
            best = min([best, *(self._cost(o, size) for o in waiting if errors[o] <= self.aim)])
            waiting = [option for option in waiting if errors[option] > self.aim]
            # No error falls faster than the cube of the voxel size.
            excess = min((errors[option] for option in waiting), default=0.0) / self.aim
            size *= min(STEP, max(LONGEST_STEP, max(excess, 1.0) ** (-1.0 / 3.0)))

    def _look(self, voxel_size: float, options: list[Option]) -> _Level:
        """Errors of options at a voxel size, at points of the zone and then around the worst of them."""
        orders = {option.order for option in options}
        count = VOXELS_PER_SIZE // (8 if orders == {1} else 64)
        points, exact = self._points(voxel_size, count)
        errors = dict.fromkeys(options, 0.0)
        random = np.random.default_rng(len(self.levels))
        for _ in range(ROUNDS):
            found = self._errors(points, exact, voxel_size, options)
            errors = {option: max(errors[option], float(found[option].max())) for option in options}
            taken = min(count // (TAKEN * len(orders)), len(points))
            # The first option of each order has the least noise.
            firsts = {option.order: option for option in reversed(options)}
            worst = np.concatenate([np.argpartition(found[o], -taken)[-taken:] for o in firsts.values()])
            self._worst = (points[np.unique(worst)], voxel_size)
            around = np.repeat(self._worst[0], AROUND, axis=0)
            step = 0.5 * voxel_size
            points, exact = self.zone.near(self.zone.moved(around, step, random), step, random)
            if len(points) == 0:
                break
        level = _Level(voxel_size, errors)
        self.levels.append(level)
        self.levels.sort(key=lambda one: -one.voxel_size)
        return level

    def _errors(
        self, points: NDArray[np.float64], exact: NDArray[np.float64], voxel_size: float, options: list[Option]
    ) -> dict[Option, NDArray[np.float64]]:
        self._evaluations += 1
        if self.progress:
            self.progress(int(LAST_PERCENT * (1.0 - 0.5 ** (self._evaluations / HALF_DONE))), 100)
        stencils = stencils_of(self.zone, points, exact, voxel_size, max(option.order for option in options))
        return {
            option: interpolation_errors(
                stencils, option.order, self.width_of(option, voxel_size) * voxel_size, self._step(option, voxel_size)
            )
            for option in options
        }

    def _points(self, voxel_size: float, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """About ``count`` points and the field there: the worst of the size before, points around them, new points."""
        seed = self.seed + 1000 * len(self.levels)
        worst, old_size = self._worst
        fresh, exact = self.zone.draw(count if len(worst) == 0 else count // 2, seed)
        if len(worst) == 0:
            return fresh, exact
        random = np.random.default_rng(seed)
        moves = np.geomspace(voxel_size, old_size, MOVES)
        old = np.concatenate([worst, *(self.zone.moved(worst, size, random) for size in moves)])[: count // 2]
        told = [self._told, self.zone.moved(self._told, voxel_size, random)]
        old, old_exact = self.zone.near(np.concatenate([old, *told]), voxel_size, random)
        return np.concatenate([old, fresh]), np.concatenate([old_exact, exact])

    def _step(self, option: Option, voxel_size: float) -> float:
        if option.codec == "fpn":
            return 2.0 * option.share * self.tolerance
        return quantization_step(option.codec, self.width_of(option, voxel_size), voxel_size)

    def _brackets(self, option: Option) -> tuple[_Level | None, _Level | None]:
        """The coarsest size that keeps the aim, and the next coarser one, which does not.

        Errors are not monotone in the voxel size, because a lattice may suit a flat face. Such a size counts too.
        """
        above = None
        for level in self.levels:
            if option not in level.errors:
                continue
            if level.errors[option] <= self.aim:
                return above, level
            above = level
        return above, None

    def _setting(self, option: Option) -> Setting | None:
        _, level = self._brackets(option)
        if level is None or not self.fits(option, level.voxel_size):
            return None
        size, width = level.voxel_size, self.width_of(option, level.voxel_size)
        counts = self.memory.counts(size, width * size)
        return Setting(option, size, width, level.errors[option], counts, self._bits(option, size))

    def _is_close(self, setting: Setting) -> bool:
        above, below = self._brackets(setting.option)
        assert below is not None
        return above is None or below.voxel_size > CLOSE * above.voxel_size

    def _between(self, option: Option) -> float:
        """Voxel size at which the error is expected to equal the aim."""
        above, below = self._brackets(option)
        assert above is not None
        assert below is not None
        slope = math.log(above.errors[option] / max(below.errors[option], 1e-300))
        share = math.log(above.errors[option] / self.aim) / max(slope, 1e-12)
        # Keep away from both ends, where errors are known already.
        share = min(max(share, 0.15), 0.85)
        return float(above.voxel_size * (below.voxel_size / above.voxel_size) ** share)

    def _cost(self, option: Option, voxel_size: float) -> float:
        counts = self.memory.counts(voxel_size, self.width_of(option, voxel_size) * voxel_size)
        return counts.bytes_of(option.codec, self._bits(option, voxel_size))

    def _bits(self, option: Option, voxel_size: float) -> float:
        """Bits per voxel in "fpn", the mean over the leaves, from their ranges and the step."""
        if option.codec != "fpn":
            return 0.0
        width = self.width_of(option, voxel_size)
        # Leaf ranges change little within a quarter of a voxel of width, so widths are rounded to share results.
        key = float(np.ceil(4.0 * width) / 4.0)
        if key not in self._shares:
            self._shares[key] = self.leaf_ranges(key)
        levels = self._shares[key] * (2.0 * width * voxel_size / self._step(option, voxel_size))
        return float(LEAF_BITS[np.searchsorted(2.0 ** LEAF_BITS[:-1] - 1.0, levels)].mean())

    def fits(self, option: Option, voxel_size: float) -> bool:
        """Whether such a band can be built in the available memory."""
        counts = self.memory.counts(voxel_size, self.width_of(option, voxel_size) * voxel_size)
        return counts.working_bytes <= self.most_bytes


def quickest(settings: list[Setting]) -> Iterator[Setting]:
    """The settings in the order of trial; of about equal memory, the fastest to read first."""
    rest = sorted(settings, key=lambda setting: setting.byte_count)
    while rest:
        equal = [s for s in rest if s.byte_count <= SAME_MEMORY * rest[0].byte_count]
        chosen = min(equal, key=lambda s: (s.option.order, CODECS.index(s.option.codec)))
        rest.remove(chosen)
        yield chosen
