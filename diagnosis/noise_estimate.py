"""The noise under which residuals are most likely, and which of its parts they show."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_likelihood import Residuals
from latticebench.diagnosis.rows import Rows
from latticebench.diagnosis.walk_estimate import walked

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.noise import Readings

# Slow noise beside a white one is looked for in correlations over so many readings, of innovations up to so many sizes.
LAGS, OUTLYING = 16, 3.0
# Nats that each part of the structure but `white` and `common` must win beyond Schwarz' penalty. Five parts are tried,
# on records of less than a hundred readings as well, and equal white sensors are to keep the simplest form in 98 of 100
# records.
MARGIN = 2.0
# Readings that the structure is chosen from, in stretches all over a longer record: what so many do not show changes
# sizes by less than a per cent.
GLANCE, STRETCHES = 20_000, 10
# Of a sensor's readings a fit leaves at least this share free.
SPARE = 0.2
# Steps to the size of a sensor whose noise is otherwise known: each takes it most of the way.
LENT = 8


def estimate(
    left: Readings, level: Readings, rows: Rows, *, free: Float[ndarray, " sensors"] | float = 0.0,
    structure: Structure | None = None, start: Noise | None = None, mixed: bool = True,
) -> Noise:  # fmt: skip
    """Return the noise under which residuals are most likely.

    Args:
        left: readings less what a model says, NaN where nothing was read.
        level: what the model says, in the same units.
        rows: times and sensors of both.
        free: how many numbers the fit of the model took from the n readings, of each sensor or of all together. Such a
            fit leaves residuals that are too small: sizes are multiplied by sqrt(n / (n - free)).
        structure: which parts to use; chosen by Schwarz' criterion if left out.
        start: where to start, such as the noise at the last step of an iteration.
        mixed: whether noise may be of two kinds where the structure is chosen: in common and not, or white and slow.
    """
    residuals = Residuals.of(left, level, rows)
    apart = np.isin(rows.sensor, list(rows.curved | rows.walking))
    others = bool(np.any(np.isfinite(left[:, ~apart])))
    plain = np.where(apart, np.nan, left) if np.any(apart) and others else left
    if structure is not None and rows.walking and not others:
        # Where all zeros wander, growth, tails and what is common are not told from the walks.
        structure = replace(structure, growth=False, tails=False, white=False, common=False)
    if structure is None:
        start = _chosen(Residuals.of(*_glance(plain, level, rows)), mixed)
        structure = start.structure
    if plain is left:
        found = preferred(residuals, structure, start)[0]
    else:
        known = preferred(Residuals.of(plain, level, rows), structure, start)[0]
        found = _lent(known, residuals, left, level, rows)
    if rows.walking:
        found = walked(found, left, level, rows, start)
    if found.structure.white and not np.any(found.white):
        found = replace(found, structure=replace(found.structure, white=False), white=np.zeros(0), price=0.0)
    everything, taken = len(residuals.value), float(np.sum(free))
    scale = float(np.sqrt(everything / max(everything - taken, 1.0))) if everything else 1.0
    own = np.full(residuals.sensors, scale)
    if np.ndim(free) and found.structure.own_sizes:
        count = np.bincount(residuals.sensor, minlength=residuals.sensors)
        own = np.sqrt(np.maximum(count, 1) / np.maximum(count - free, SPARE * np.maximum(count, 1)))
    return replace(found, size=found.size * own, growth=found.growth * scale, walk=found.walk * own[: len(found.walk)])


def _glance(left: ndarray, level: ndarray, rows: Rows) -> tuple[ndarray, ndarray, Rows]:
    """Return stretches of a long record, each a piece of its own; of a short one all there is."""
    count, kept = len(rows.times), GLANCE // max(len(rows.sensor), 1)
    if count <= kept:
        return left, level, rows
    begin = np.linspace(0, count - kept // STRETCHES, STRETCHES).astype(int)
    few = (begin[:, None] + np.arange(kept // STRETCHES)).ravel()
    first = rows.first[few]
    first[:: kept // STRETCHES] = True
    return left[few], level[few], replace(rows, times=rows.times[few], first=first)


def _chosen(residuals: Residuals, mixed: bool) -> Noise:
    """Return the noise of the structure that Schwarz' criterion prefers, found step by step.

    One part is added or taken away at a time, whichever helps most, until nothing helps: what one part did alone may
    later be done better by another.
    """
    tried: dict[Structure, tuple[float, Noise]] = {}
    each = residuals.each
    # The common part takes long to fit: it is left alone where it is far from worth its two numbers.
    possible = [part for part in residuals.possible if mixed or part not in ("common", "white")]
    alone = "common" in possible and residuals.beside.promises(residuals.value) < each + rules.IN_COMMON / 2
    parts = [part for part in possible if part != "common" or not alone]

    def price(structure: Structure, near: Noise | None) -> float:
        if structure not in tried:
            noise, nats = preferred(residuals, structure, near)
            margins = MARGIN * (sum(vars(structure).values()) - structure.white - structure.common)
            margins += noise.price + rules.IN_COMMON * structure.common
            tried[structure] = each * noise.parameters + margins - nats, noise
        return tried[structure][0]

    here = Structure()
    price(here, None)
    while not residuals.is_exact():
        found = tried[here][1]
        ways = [replace(here, **{part: not getattr(here, part)}) for part in parts]
        best = min(ways, key=lambda one: price(one, found))
        if tried[best][0] >= tried[here][0]:
            break
        here = best
    return tried[here][1]


def preferred(residuals: Residuals, structure: Structure, start: Noise | None) -> tuple[Noise, float]:
    """Return the noise of greatest likelihood with a given structure, and its log likelihood.

    A part is white besides a slow one only where that is worth its price: both together do the work of weak forces.
    """
    plain, nats = residuals.likeliest(replace(structure, white=False), start)
    if not structure.white or not plain.structure.memory or plain.structure.common or residuals.is_exact():
        return plain, nats
    groups = len(np.unique(residuals.sensor)) if structure.own_sizes else 1
    price = residuals.each * groups + rules.BESIDE_WHITE
    known = start is not None and len(start.white) > 0
    if not known and _unsettled(residuals, plain) < price / 2:
        return plain, nats
    both, higher = residuals.likeliest(structure, start if known else plain)
    return (replace(both, price=price), higher) if higher > nats + price else (plain, nats)


def _unsettled(residuals: Residuals, noise: Noise) -> float:
    """Return about how many nats the correlations of innovations over some readings are worth.

    Of n pairs of independent numbers the squared correlation times n / 2 is 1/2 nat on the mean.
    """
    group, groups = residuals.groups(noise.structure)
    size = (noise.size if noise.structure.own_sizes else noise.size[:1]) / residuals.unit
    time = (noise.memory if noise.structure.own_sizes else noise.memory[:1]) / residuals.interval
    near = np.where(time > 0, np.exp(-1 / np.where(time > 0, time, 1.0)), 0.0)
    *_, z = residuals.innovations(size[group], noise.growth, near[group], white=False)
    z = np.clip(z, -OUTLYING, OUTLYING)
    begin = np.flatnonzero(~residuals.linked)
    place = np.arange(len(z)) - np.repeat(begin, np.diff(begin, append=len(z)))
    variance = np.bincount(group, z**2, minlength=groups) / np.maximum(np.bincount(group, minlength=groups), 1)
    nats = 0.0
    for lag in range(1, min(LAGS, int(np.max(place))) + 1):
        pairs = np.flatnonzero(place >= lag)
        count = np.bincount(group[pairs], minlength=groups)
        total = np.bincount(group[pairs], z[pairs] * z[pairs - lag], minlength=groups)
        there = (count > 0) & (variance > 0)
        nats += float(np.sum((total[there] / variance[there]) ** 2 / count[there] - 1)) / 2
    return nats


def _lent(noise: Noise, residuals: Residuals, left: Readings, level: Readings, rows: Rows) -> Noise:
    """Return the noise of all sensors, of which some have a size of their own and all else from the others."""
    borrows = np.isin(np.arange(residuals.sensors), list(rows.curved))
    if noise.common is not None:
        known = ~borrows & (noise.common.share != 0)
        mean = np.mean(noise.common.share[known]) if np.any(known) else 0.0
        share = np.where(borrows, mean, noise.common.share)
        noise = replace(noise, common=replace(noise.common, share=share))
    if not noise.structure.own_sizes:
        return noise
    alike = np.isin(np.arange(residuals.sensors), residuals.sensor)
    alike[list(rows.curved | rows.walking)] = False
    memory = np.where(borrows, np.mean(noise.memory[alike]), noise.memory)
    white = np.where(borrows, np.mean(noise.white[alike]), noise.white) if len(noise.white) else noise.white
    first = residuals.plain(noise.structure).size / (np.sqrt(2) if np.isfinite(noise.tail) else 1.0)
    found = replace(noise, size=np.where(borrows, first, noise.size), memory=memory, white=white)
    for _ in range(LENT):
        size = np.maximum(found.size * np.sqrt(_excess(found, left, level, rows)), residuals.floor * residuals.unit)
        found = replace(found, size=np.where(borrows, size, noise.size))
    return found


def _excess(noise: Noise, left: Readings, level: Readings, rows: Rows) -> Float[ndarray, " sensors"]:
    """Return by how much the variance of each sensor's innovations is beyond that of the noise, weighed by it."""
    whitener, sensors = noise.whitener(level, rows, np.isfinite(left)), len(noise.size)
    z = whitener.apply(np.where(whitener.seen, left, 0.0))
    square = np.sum((whitener.robust(z) * z) ** 2, axis=0)
    count = np.bincount(rows.sensor, np.sum(whitener.seen, axis=0), minlength=sensors)
    mean = np.bincount(rows.sensor, square, minlength=sensors) / np.maximum(count, 1)
    return np.where(mean > 0, mean, 1.0)
