"""Where a residual lives: sites, times and frequencies at which there is more of it than noise would leave.

Residuals are in units of the noise, sites are counted from 1, frequencies are angular ones.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pydantic

from latticebench.bench.report.document import Content
from latticebench.diagnosis.instrument import two_digits
from latticebench.diagnosis.noise import Noise
from latticebench.diagnosis.rows import Rows

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.fitting import Curve, Fitted
    from latticebench.diagnosis.repair import Diagnosis

    Trajectory = tuple[Float[ndarray, " time"], Float[ndarray, "time levels parts sites"]]

# A recording is cut into so many windows to find when the residual is large.
WINDOWS = 12
# Chance that pure noise has a site, a window or a frequency named.
CHANCE = 0.01


class SiteResidual(Content):
    """RMS of the residual at a site, in units of the noise."""

    site: int
    residual: float


class WindowResidual(Content):
    """RMS of the residual in a window of time, in units of the noise."""

    begin: float = pydantic.Field(validation_alias="from", serialization_alias="from")
    end: float = pydantic.Field(validation_alias="to", serialization_alias="to")
    residual: float


class Line(Content):
    """A line in the residual's spectrum: angular frequency, and power over that of the noise."""

    omega: float
    power: float


class Whereabouts(Content):
    """Where there is more of a residual than noise would leave, the largest first, and the same in words."""

    sites: tuple[SiteResidual, ...]
    times: tuple[WindowResidual, ...]
    frequencies: tuple[Line, ...]
    words: tuple[str, ...]


def scaled_residuals(fitted: Fitted, diagnosis: Diagnosis) -> list[Trajectory]:
    """Return times and residual of each trajectory, in units of the noise and NaN where nothing was seen."""
    noise = diagnosis.after.noise
    rest = np.reshape(diagnosis.noise, (-1, 1, diagnosis.after.chain.sites))
    # Of Student's t the standard deviation is larger than the scale, which is what grows.
    growth = noise.growth * float(np.nanmax(noise.deviation() / noise.size))
    return [(one.t, (one.seen - one.level) / np.hypot(rest, growth * one.swing)) for one in fitted.curves()]


def _innovations(fitted: Fitted, diagnosis: Diagnosis) -> list[Trajectory]:
    """Return what of each reading's residual does not follow from the one before, in units of what noise leaves.

    Correlated noise is uncorrelated then, and outliers of heavy tails are brought in, so that the mean square is 1.
    """
    # Curves follow the zeros that wander.
    noise = replace(diagnosis.after.noise, walk=np.zeros(0))
    # Where readings show less noise than the model leaves, the rest is no noise; of correlated noise they show a part.
    correlated = (noise.memory > 0) | (noise.common is not None)
    unit = np.where(correlated, 1.0, noise.deviation() / diagnosis.noise)
    return [(one.t, _whitened(one, noise, unit)) for one in fitted.curves()]


def _whitened(
    curve: Curve, noise: Noise, unit: Float[ndarray, " sensors"]
) -> Float[ndarray, "time levels parts sites"]:
    rows, levels, parts, sites = curve.seen.shape
    sensor = np.broadcast_to(np.arange(levels * sites).reshape(levels, 1, sites), (levels, parts, sites)).ravel()
    left, swing = (one.reshape(rows, -1) for one in (curve.seen - curve.level, curve.swing))
    seen = np.isfinite(left)
    whitener = noise.whitener(swing, Rows(curve.t, np.arange(rows) == 0, sensor), seen)
    z = whitener.apply(left)
    return np.where(seen, z * whitener.robust(z) * unit[sensor], np.nan).reshape(curve.seen.shape)


def whereabouts(fitted: Fitted, diagnosis: Diagnosis) -> Whereabouts:
    """Return where there is more of a residual than noise of the estimated size would leave by chance."""
    trajectories = _innovations(fitted, diagnosis)
    count = trajectories[0][1].shape[-1]
    sites = []
    for site in range(count):
        size = _beyond_chance(np.concatenate([left[..., site].ravel() for _, left in trajectories]), count)
        if size is not None:
            sites.append(SiteResidual(site=site + 1, residual=size))
    times, windows = [], 0
    for t, left in trajectories:
        edges = np.unique(np.linspace(0, len(t), WINDOWS + 1).astype(int))
        for begin, end in itertools.pairwise(edges):
            windows += 1
            size = _beyond_chance(left[begin:end], WINDOWS * len(trajectories))
            if size is not None:
                times.append(WindowResidual(begin=float(t[begin]), end=float(t[end - 1]), residual=size))
    sites.sort(key=lambda one: -one.residual)
    times.sort(key=lambda one: -one.residual)
    lines = [line for t, left in trajectories for line in _lines(t, left)]
    strongest = sorted(lines, key=lambda one: -one.power)[:WINDOWS]
    words = _words(sites, times, strongest, sites_in_all=count, windows_in_all=windows)
    return Whereabouts(sites=tuple(sites), times=tuple(times), frequencies=tuple(strongest), words=tuple(words))


def _beyond_chance(values: ndarray, tries: int) -> float | None:
    """Return the RMS of values where it is beyond chance, else None."""
    from scipy.stats import chi2

    seen = values[np.isfinite(values)]
    size = float(np.mean(seen**2)) if len(seen) else 0.0
    return float(np.sqrt(size)) if len(seen) and size > chi2.isf(CHANCE / tries, len(seen)) / len(seen) else None


def _lines(t: ndarray, left: ndarray) -> list[Line]:
    """Return the peaks of a residual's spectrum that are beyond chance."""
    from scipy.stats import chi2

    omega, power, weight = spectrum(t, left)
    if len(omega) < 3:
        return []
    limit = chi2.isf(CHANCE / len(omega), 2 * weight) / (2 * weight)
    padded = np.concatenate([[0.0], power, [0.0]])
    peaks = (power > limit) & (power >= padded[:-2]) & (power >= padded[2:])
    return [Line(omega=float(w), power=float(p)) for w, p in zip(omega[peaks], power[peaks], strict=True)]


def spectrum(t: ndarray, left: ndarray) -> tuple[ndarray, ndarray, int]:
    """Return the residual's power at angular frequencies, the mean over all readings; white noise has 1 on average.

    Args:
        t: times (T,); uneven ones are brought onto an even grid by straight lines.
        left: residual in units of the noise (T, levels, parts, N).

    Returns:
        frequencies (F,), powers (F,), and how many series went into the mean.
    """
    series = left.reshape(len(t), -1)
    series = series[:, np.sum(np.isfinite(series), axis=0) > 2]
    if series.shape[1] == 0 or len(t) < 4:
        return np.zeros(0), np.zeros(0), 1
    even = np.linspace(t[0], t[-1], len(t))
    filled = [np.interp(even, t[np.isfinite(one)], one[np.isfinite(one)]) for one in series.T]
    # The trajectories' starts were fitted, and with them the mean: there is no power at 0.
    power = np.mean(np.abs(np.fft.rfft(np.stack(filled), axis=1)) ** 2, axis=0) / len(t)
    omega = 2 * np.pi * np.fft.rfftfreq(len(t), even[1] - even[0])
    return omega[1:], power[1:], series.shape[1]


def _words(
    sites: list[SiteResidual],
    times: list[WindowResidual],
    lines: list[Line],
    *,
    sites_in_all: int,
    windows_in_all: int,
) -> list[str]:
    """Return in words where a residual lives."""
    if not (sites or times or lines):
        return ["No site, time or frequency has more of it than noise would leave."]
    found = []
    # That the only site has it is no news.
    if sites and sites_in_all > 1:
        listed = [f"site {one.site} ({two_digits(one.residual)} times the noise)" for one in sites[:3]]
        more = f"; {len(sites)} of {sites_in_all} sites have some." if len(sites) > 3 else "."
        alike = _alike("sites", [one.residual for one in sites], sites_in_all)
        found.append(alike or f"Most at {', '.join(listed)}{more}")
    if times:
        listed = [
            f"t = {one.begin:.4g} to {one.end:.4g} ({two_digits(one.residual)} times the noise)" for one in times[:2]
        ]
        alike = _alike("times", [one.residual for one in times], windows_in_all)
        found.append(alike or f"Most at {', '.join(listed)}.")
    if lines:
        listed = [f"{one.omega:.4g}" for one in lines[:3]]
        found.append(f"Most at the angular frequenc{'y' if len(listed) == 1 else 'ies'} {', '.join(listed)}.")
    return found or ["Nowhere in particular."]


def _alike(noun: str, sizes: list[float], in_all: int) -> str:
    """Return a sentence where all sites or times have nearly the same residual, else nothing."""
    if len(sizes) == in_all > 1 and sizes[0] < 1.5 * sizes[-1]:
        return f"At all {noun} alike, {two_digits(sizes[-1])} to {two_digits(sizes[0])} times the noise."
    return ""
