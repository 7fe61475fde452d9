"""Analysis: leveled contrasts locked to the turns, and their significance by flipped signs.

One contrast for each block, setting and channel: the mean with the object less that without, free
of any drift that is linear in time. The test is Fisher's: the order of each block was drawn by a
coin, so that without any effect of the object each pattern of signs is as likely as the observed
one, whatever noise and drift are. The largest value over cells, channels, settings and sizes of
patches is compared with the same largest value under flipped signs, which holds the probability of
any false alarm in the whole family (Westfall and Young, 1993).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, sqrt

import cv2
import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.detect.levelling import level, quiet_cells
from nlos_cam.detect.plan import BLOCK_TURNS, Plan, min_blocks
from nlos_cam.detect.turns import CHANNELS, Turn
from nlos_cam.errors import RecordingError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS
from nlos_cam.render import DEPTH_UNIT_M

PATCHES = 1, 3, 9
"""Sides in cells of the patches over which contrasts are averaged."""
MAX_PATTERNS = 4096
"""Patterns of signs; all of them up to 13 blocks, drawn at random beyond."""
PRIOR = 4.0
"""Weight of the noise within turns against that between blocks, in units of the blocks."""
QUANTA = DEPTH_UNIT_M, 1.0, 1.0
PIXELS_PER_CELL = 60.0
"""Steps of one pixel in each channel, and pixels whose mean or median a cell is: below the noise of
that rounding no cell is believed to be quiet.
"""
POWER = 0.9
POWER_DRAWS = 100
MAX_NOISES = 1e4
"""Draws of noise from which the smallest effect with this power is found, and the effect, in
noises, beyond which the search ends.
"""
POWER_PATTERNS = 512
POWER_LARGER = 4
"""Patterns of signs that the power is tested with: this many, or as many more as let so many of
them be larger at the rate of false alarms.
"""
POWER_SEED = 1
PATTERN_SEED = 0
LASER = "ldd_temperature"
"""The SDK's name of the laser driver's temperature."""
Mask = NDArray[np.bool_]


def _no_progress(_done: int, _total: int) -> None:
    """Show nothing."""


@dataclass(frozen=True)
class Finding:
    """Result for one setting, channel and size of patches."""

    setting: str
    channel: str
    patch: int
    """Side in cells."""
    p_value: float
    """Probability of a value as large anywhere in the family, without any effect."""
    peak: float
    """Mean contrast where it is most significant, in standard deviations of the noise of a mean."""
    cell: tuple[int, int]
    """Row and column of that patch's middle."""
    effect: float
    """Contrast there, object in less object out: m, counts, or steps of confidence."""
    smallest: float
    """Effect in one patch that would be found with a probability of 90 %, at the median cell."""
    smallest_best: float
    """The same at the quietest tenth of the cells."""
    significance: Float64
    """(64, 80); signed scores of the test, NaN where a cell is not used."""
    contrast: Float64
    """(64, 80); in the channel's unit."""


@dataclass(frozen=True)
class Analysis:
    """Verdict on the turns of a session."""

    plan: Plan
    blocks: int
    patterns: int
    """Patterns of signs compared, with the observed one."""
    p_value: float
    """Probability of a value as large as the largest of all, without any effect."""
    detected: bool
    findings: tuple[Finding, ...]
    """Most significant first."""
    celsius: tuple[float, float] | None
    """Lowest and highest temperature of the laser driver over the turns."""

    @property
    def complete(self) -> bool:
        """True once every planned block was measured."""
        return self.blocks == self.plan.blocks


@dataclass(frozen=True)
class Group:
    """Contrasts of one setting, channel and size of patches, on the n cells that are used."""

    setting: str
    channel: str
    patch: int
    values: Float64
    """(blocks, n); in the channel's unit."""
    frame_noise: Float64
    """(n,); standard deviation of one block by the noise of frames alone."""
    used: Mask
    """(64, 80)."""

    @cached_property
    def noise(self) -> Float64:
        """Standard deviation (n,) of one block, with what there is between turns beside the frames'
        noise: levelling's own errors, drift that is not linear.
        """
        # The median over the cells of the blocks' mean square, over its expectation, says how much
        # more there is; the median of chi^2 / N is about (1 - 2 / 9N)^3.
        ratio = np.median(np.mean(self.values**2, axis=0) / self.frame_noise**2)
        excess = float(ratio) / (1.0 - 2.0 / (9.0 * len(self.values))) ** 3
        return self.frame_noise * sqrt(max(excess, 1.0))

    def without_effect(self) -> "Group":
        """Return the group less its mean contrast: what is left is noise of the same size."""
        blocks = len(self.values)
        rest = (self.values - self.values.mean(axis=0)) * sqrt(blocks / (blocks - 1.0))
        return replace(self, values=rest)

    def scores(self, signs: Float64) -> Float64:
        """Return significances (patterns, n) of the mean contrast under patterns of signs.

        Their scale has the effect itself in it: none is above sqrt((PRIOR + 1) blocks).
        """
        return (signs @ self.values) / (self.moderated * sqrt(len(self.values)))

    @cached_property
    def moderated(self) -> Float64:
        """Standard deviation (n,) of one block, from the noise and the blocks' own squares."""
        return moderate(self.values, self.noise)


def moderate(values: Float64, noise: Float64) -> Float64:
    """Return sqrt of the mean of noise^2 and of the blocks' squares (blocks, n), the first with
    PRIOR.
    """
    # Squares keep their value under flipped signs, so the test stays exact. With few blocks their
    # squares alone would give a few cells a tiny noise, and a huge significance by chance.
    return np.sqrt((PRIOR * noise**2 + np.mean(values**2, axis=0)) / (PRIOR + 1.0))


def analyze(
    plan: Plan,
    turns: list[Turn],
    on_step: Callable[[int, int], None] = _no_progress,
    *,
    with_power: bool = True,
) -> Analysis:
    """Return the verdict on all whole blocks of the turns, in the plan's order.

    Without `with_power` the smallest effects are NaN, and it takes a third of the time.

    Raises RecordingError for too few blocks to reach the plan's `alpha`.
    """
    blocks = len(turns) // BLOCK_TURNS
    if blocks < (least := min_blocks(plan.alpha)):
        raise RecordingError(
            f"{len(turns)} turns are too few for a false-alarm rate of {plan.alpha:g}: measure at"
            f" least {least * BLOCK_TURNS}; the same command goes on with --out and its folder"
        )
    turns = turns[: blocks * BLOCK_TURNS]
    groups = make_groups(plan, turns)
    if not groups:
        raise RecordingError("no cell has a return in every turn: is the wall in view?")
    signs = sign_patterns(blocks)

    scale = Scale.of(groups, signs, plan.alpha, on_step)
    # Power is that of the noise alone: an effect that was found would count as noise otherwise.
    rest = [group.without_effect() for group in groups] if with_power else []
    rest_scale = Scale.of(rest, signs, plan.alpha) if with_power else None

    findings: list[Finding] = []
    for number, group in enumerate(groups):
        smallest = np.full(2, np.nan)
        if rest_scale:
            noises = smallest_in_noises(rest[number], number, rest_scale)
            smallest = noises * np.quantile(rest[number].noise, [0.5, 0.1])
        findings.append(_finding(group, number, scale, smallest))
        on_step(len(groups) + number + 1, 2 * len(groups))
    findings.sort(key=lambda each: (each.p_value, -each.peak))
    family = scale.family
    p_value = float(np.mean(family >= family[0]))
    celsius = [each.celsius[LASER] for each in turns if LASER in each.celsius]
    return Analysis(
        plan,
        blocks,
        len(signs),
        p_value,
        p_value <= plan.alpha,
        tuple(findings),
        (min(celsius), max(celsius)) if celsius else None,
    )


def sign_patterns(blocks: int) -> Float64:
    """Return patterns of signs (M, blocks), the observed one (all +1) first.

    All that differ in absolute values, or MAX_PATTERNS with random ones.
    """
    if 2 ** (blocks - 1) <= MAX_PATTERNS:
        numbers = np.arange(2 ** (blocks - 1))
        bits = (numbers[:, None] >> np.arange(blocks)) & 1
        return 1.0 - 2.0 * bits
    # The observed pattern counts among the drawn ones: p = (1 + larger) / (1 + drawn) is exact.
    generator = np.random.default_rng(PATTERN_SEED)
    signs = generator.choice([-1.0, 1.0], (MAX_PATTERNS, blocks))
    signs[0] = 1.0
    return signs


def lock_weights(times_s: Float64, object_in: Mask) -> Float64:
    """Return weights (4,) of a block's turns: their sum is the effect of the object, without offset
    and without a drift that is linear in time.
    """
    # Least squares of y = offset + drift t + effect (label + 1) / 2: by Frisch, Waugh and Lovell
    # the effect is the label's residual on the other columns, applied to y.
    label = np.where(object_in, 1.0, -1.0)
    columns = np.stack([np.ones(len(label)), times_s - times_s.mean()], axis=1)
    residual = label - columns @ np.linalg.lstsq(columns, label, rcond=None)[0]
    return 2.0 * residual / float(residual @ label)


def make_groups(plan: Plan, turns: list[Turn]) -> list[Group]:
    """Return the contrasts of all settings, channels and patches that have any noise."""
    quiet = quiet_cells(plan.rig)
    object_in = np.array([each.object_in for each in turns])
    blocks = len(turns) // BLOCK_TURNS
    groups: list[Group] = []
    for number, setting in enumerate(plan.settings):
        times_s = np.array([each.time_s[number] for each in turns]).reshape(blocks, BLOCK_TURNS)
        labels = object_in.reshape(blocks, BLOCK_TURNS)
        pairs = zip(times_s, labels, strict=True)
        weights = np.stack([lock_weights(*each) for each in pairs])
        for channel, name in enumerate(CHANNELS):
            maps = np.stack([each.mean[number, channel] for each in turns]).astype(np.float64)
            std = np.stack([each.std[number, channel] for each in turns]).astype(np.float64)
            used: Mask = np.asarray(np.isfinite(maps).all(axis=0))
            if not used.any():
                continue
            floor = QUANTA[channel] / sqrt(12.0 * PIXELS_PER_CELL)
            variance = np.maximum(std, floor) ** 2 / turns[0].frames
            noise = np.sqrt(variance.mean(axis=0))
            leveled = level(maps, np.where(used, noise, np.nan), quiet)
            by_block = leveled.reshape(blocks, BLOCK_TURNS, *maps.shape[1:])
            contrast = np.einsum("bt,btrc->brc", weights, by_block)
            spread = np.sqrt(np.mean(np.sum(weights**2, axis=1))) * noise
            groups += [
                _patches(setting.name, name, patch, contrast, spread, used) for patch in PATCHES
            ]
    return groups


def _patches(
    setting: str, channel: str, patch: int, contrast: Float64, noise: Float64, used: Mask
) -> Group:
    """Return the means over patches of contrasts (blocks, 64, 80), weighted by the noise."""
    weight = np.zeros(used.shape)
    weight[used] = 1.0 / noise[used] ** 2
    total = _sums(weight, patch)
    values = np.stack([_sums(np.where(used, weight * each, 0.0), patch) for each in contrast])
    values = values[:, used] / total[used]
    return Group(setting, channel, patch, values, 1.0 / np.sqrt(total[used]), used)


def _sums(values: Float64, patch: int) -> Float64:
    return cv2.boxFilter(
        values, -1, (patch, patch), normalize=False, borderType=cv2.BORDER_CONSTANT
    ).astype(np.float64)


@dataclass(frozen=True)
class Scale:
    """Common scale of the groups, and the family's largest values on it."""

    middle: Float64
    """(groups,)."""
    spread: Float64
    """(groups,)."""
    family: Float64
    """(patterns,); the observed pattern first."""
    alpha: float

    highest: Float64
    """(groups, patterns); largest absolute significance over the cells."""

    @classmethod
    def of(
        cls,
        groups: list[Group],
        signs: Float64,
        alpha: float,
        on_step: Callable[[int, int], None] = _no_progress,
    ) -> "Scale":
        """Return the scale of groups under patterns of signs (patterns, blocks)."""
        highest = np.empty((len(groups), len(signs)))
        for number, group in enumerate(groups):
            for part in np.array_split(np.arange(len(signs)), max(1, len(signs) // 256)):
                highest[number, part] = np.abs(group.scores(signs[part])).max(axis=1)
            on_step(number + 1, 2 * len(groups))
        # Median and spread over all patterns, the observed one among them, put the groups on one
        # scale; both are the same whichever pattern was observed, so the test stays exact.
        middle = np.median(highest, axis=1)
        spread = np.median(np.abs(highest - middle[:, None]), axis=1)
        spread = np.where(spread > 0, spread, np.maximum(middle, 1e-12))
        family = ((highest - middle[:, None]) / spread[:, None]).max(axis=0)
        return cls(middle, spread, family, alpha, highest)

    def p_value(self, group: int) -> float:
        """Return the probability of a group's observed value anywhere in the family."""
        scaled = (self.highest[group, 0] - self.middle[group]) / self.spread[group]
        larger = np.count_nonzero(self.family[1:] >= scaled)
        return (1.0 + float(larger)) / len(self.family)


def _finding(group: Group, number: int, scale: Scale, smallest: Float64) -> Finding:
    observed = group.scores(np.ones((1, len(group.values))))[0]
    peak = int(np.argmax(np.abs(observed)))
    mean = group.values.mean(axis=0)
    significance = np.full(group.used.shape, np.nan)
    significance[group.used] = observed
    contrast = np.full(group.used.shape, np.nan)
    contrast[group.used] = mean
    row, column = np.argwhere(group.used)[peak]
    return Finding(
        group.setting,
        group.channel,
        group.patch,
        scale.p_value(number),
        float(abs(mean[peak]) * sqrt(len(group.values)) / group.noise[peak]),
        (int(row), int(column)),
        float(mean[peak]),
        float(smallest[0]),
        float(smallest[1]),
        significance,
        contrast,
    )


def smallest_in_noises(group: Group, number: int, scale: Scale) -> float:
    """Return the effect in one patch, in noises of one block, that is found with a probability of
    POWER; the group is one without effect.

    By injection: values of random cells under random signs are draws of the noise. An effect is
    added, and the whole test is run again on those cells; the others keep their largest value,
    which is that of a random pattern.
    """
    generator = np.random.default_rng(POWER_SEED)
    blocks = len(group.values)
    # An effect that fills a patch also lies in the patches that overlap with it, which compete with
    # it under flipped signs.
    cells, share = _overlapping(group, generator)
    noise = (group.values / group.noise)[:, cells]
    draws = noise * generator.choice([-1.0, 1.0], (blocks, len(cells), 1))

    patterns = _some_patterns(scale, generator)
    signs = sign_patterns(blocks)[patterns]
    others = np.stack(
        [generator.permutation(scale.family)[: len(patterns)] for _ in range(len(cells))], axis=1
    )

    def power(effect: float) -> float:
        values = draws + effect * share
        flat = values.reshape(blocks, -1)
        scores = np.abs(signs @ flat) / (moderate(flat, np.ones(flat.shape[1])) * sqrt(blocks))
        own = scores.reshape(len(signs), *cells.shape).max(axis=2)
        highest = np.maximum((own - scale.middle[number]) / scale.spread[number], others)
        p_values = np.mean(highest >= highest[0], axis=0)
        return float(np.mean(p_values <= scale.alpha))

    return _smallest_of_power(power)


def _some_patterns(scale: Scale, generator: np.random.Generator) -> NDArray[np.int64]:
    """Return the numbers of sign patterns that are enough for p-values near alpha: the observed
    one, 0, and others at random.
    """
    patterns = np.arange(len(scale.family))
    wanted = max(POWER_PATTERNS, ceil(POWER_LARGER / scale.alpha))
    if len(patterns) <= wanted:
        return patterns
    drawn = generator.choice(patterns[1:], wanted - 1, replace=False)
    return np.concatenate([[0], drawn])


def _smallest_of_power(power: Callable[[float], float]) -> float:
    """Return the smallest effect that a rising function gives a probability of POWER; infinity
    beyond MAX_NOISES.
    """
    low = 0.0
    high = 1.0
    while power(high) < POWER:
        low = high
        high = 2.0 * high
        if high > MAX_NOISES:
            return float("inf")
    for _ in range(8):
        middle = (low + high) / 2.0
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high


def _overlapping(group: Group, generator: np.random.Generator) -> tuple[NDArray[np.int64], Float64]:
    """Return used cells (draws, k), each the middle of a patch and of those that overlap with it,
    and the share (draws, k) of an effect in the first that lies in each.
    """
    rows, columns = MAP_ROWS, MAP_COLUMNS
    index = np.full((rows, columns), -1)
    index[group.used] = np.arange(np.count_nonzero(group.used))
    places = np.argwhere(group.used)
    centers = places[generator.integers(len(places), size=POWER_DRAWS)]
    # Neighbors at one cell, and at a third of the patch, which is the same for the smaller patch.
    third = group.patch // 3
    steps = [0] if group.patch == 1 else sorted({-third, -1, 0, 1, third})
    cells: list[NDArray[np.int64]] = []
    shares: list[Float64] = []
    for down in steps:
        for right in steps:
            row = centers[:, 0] + down
            column = centers[:, 1] + right
            inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            at = np.where(inside, index[row * inside, column * inside], -1)
            overlap = (1.0 - abs(down) / group.patch) * (1.0 - abs(right) / group.patch)
            shares.append(np.where(at >= 0, overlap, 0.0))
            cells.append(np.maximum(at, 0))
    return np.stack(cells, axis=1), np.stack(shares, axis=1)
