"""How well a fitted equation describes the recordings that it was fitted to, whatever method fitted it.

From smoothed states, all over a recording, the equation is followed for half a period of its main frequency, to where
the readings are known. A site that was never read starts as the motion of the equation has it that is nearest to the
readings. What is missed is compared with what a motion without forces misses (the share of the forces' work that is
left), with the readings' variance (R^2), and with the noise that neighbouring readings show
(`latticebench.diagnosis.instrument`). Integrals suffer far less from noise than derivatives do, so that even of noisy
readings a right equation explains most. Where the method followed the motion itself, what is left of that is compared
with the noise as well (`latticebench.bench.noise`). The truth of simulated samples takes no part.

A chain of more than WIDE sites is judged by some windows of it, which a seed chooses; their outer sites move as they
were read.

Nor is a coefficient of use that the readings do not determine, whatever the motion that it goes with.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.noise import left_by, of_sensors
from latticebench.bench.overlay import motion_of
from latticebench.diagnosis.instrument import two_digits
from latticebench.diagnosis.spectrum import Spectrum
from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.engine.dynamics import Dynamics, split_parts
from latticebench.methods.engine.record import without_halves
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.methods.engine.starts import smooth
from latticebench.methods.engine.windows import WINDOW, is_wide, window
from latticebench.systems.samples import Samples, SimulatedSamples

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

    from latticebench.methods.method import Fit

# An equation misfits where it leaves more than this share of the forces' work, and so many times the noise. Of four
# lattices, 50 samples each, the right coefficients leave at most 0.003 without noise, and 1.2 times the noise with it.
SHARE, TIMES = 0.02, 2.5
# Where the readings do not show their noise, it misfits beyond this share.
WITHOUT_NOISE = 0.5
# A coefficient is not determined where its standard error is worth so many times all forces together.
UNKNOWN = 10.0
# Places that it is followed from in each recording, at most, and the share of them that it meets worst: these are left
# out, since smoothed states are poor at the ends of a recording.
MOST, WORST = 40, 0.1
# Sites of a chain that are followed at once, and the windows of a longer one that are looked at instead.
WIDE, PLACES, SEED = 512, 6, 1
# Tolerance of the integration, as a share of the readings' size.
TOLERANCE = 1e-4
# Beyond so many times the readings' size a motion has run away; how far does not matter.
AWAY = 10.0
TINY = np.finfo(float).tiny
# Terms that a warning names.
LISTED = 4
# Stretches that half a period is followed in, at most.
HOPS = 16
# Steps of integration in each of them, at most: twenty in each wave of a motion a hundred times as fast.
STEPS = 64


@dataclass(frozen=True)
class Adequacy:
    """How well an equation fits.

    Attributes:
        work: share of the forces' work over half a period that is left (root mean square, 0 to 1 and beyond).
        r2: R^2 of the readings half a period ahead, 1 where they are met.
        times: what is left in units of the noise of the readings; of the motion that the method followed, if it
            followed one. NaN where the readings do not show their noise, or have none.
        fits: whether the equation describes the readings, and they determine its coefficients.
        warnings: what a user has to know, the most important first; empty where the equation fits.
        unknown: the terms whose coefficients the readings do not determine.
        unread: the columns of sites that were never read, which move as the equation says.
        silent: whether the readings have no noise.
    """

    work: float
    r2: float
    times: float
    fits: bool
    warnings: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    unread: str = ""
    silent: bool = False

    def state(self, status: str) -> str:
        """Return in a few words how a fit came out that says `status` of itself."""
        if self.fits or status != "ok":
            return status
        return "not determined by the readings" if self.unknown else "does not fit"

    def also(self, lines: tuple[str, ...]) -> Adequacy:
        """Return the same with hints at a cause, where the equation does not fit."""
        return self if self.fits else replace(self, warnings=(*self.warnings, *lines))

    @property
    def in_words(self) -> str:
        """The numbers in one line."""
        parts = []
        if np.isfinite(self.work):
            # Of noisy readings much is left by a right equation, too.
            by_noise = self.fits and self.work > SHARE and self.times <= TIMES
            parts.append(
                f"half a period ahead it leaves {two_digits(100 * self.work)} % of what the forces do"
                + (", as much as the noise lets anybody see" if by_noise else "")
            )
        if np.isfinite(self.r2):
            parts.append(f"R^2 = {self.r2:.4g}" if self.r2 > -1 else "R^2 < -1")
        hidden = "the readings have no noise" if self.silent else "the noise is not seen"
        parts.append(hidden if np.isnan(self.times) else f"{two_digits(self.times)} times the noise is left")
        if self.unread:
            parts.append(f"nothing was read of {self.unread}")
        return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums of squares for each place of one recording: what the equation leaves, what forces do, and the readings'.

    In `noise` what is left is in units of the noise, over the readings that show theirs, of which there are `told`.
    `silent` says of which recording no reading has any.
    """

    silent: Bool[ndarray, " place"]
    left: Float[ndarray, " place"]
    forces: Float[ndarray, " place"]
    spread: Float[ndarray, " place"]
    noise: Float[ndarray, " place"]
    told: Float[ndarray, " place"]


def adequacy(data: Sequence[Samples], fit: Fit) -> Adequacy:
    """Return how well a fit describes recordings.

    Raises:
        InputError: the equation cannot be set up on them.
    """
    shown = [without_halves(one.observed() if isinstance(one, SimulatedSamples) else one) for one in data]
    if is_wide(shown, fit.library, WIDE):
        shown, fit = _at_places(shown, fit)
    courses = [_course(one, fit, number) for number, one in enumerate(shown) if len(one.t) > DEGREE]
    sums = [_followed(one, fit) for one in courses]
    if not sums:
        return Adequacy(np.nan, np.nan, np.nan, fits=True)
    place = {name: np.concatenate([getattr(one, name) for one in sums]) for name in vars(sums[0])}
    best = np.argsort(place["left"])[: max(1, round((1 - WORST) * len(place["left"])))]
    silent = bool(np.all(place.pop("silent")))
    left, forces, spread, noise, told = (float(np.sum(one[best])) for one in place.values())
    work = float(np.sqrt(left / forces)) if forces > 0 else np.nan
    r2 = 1 - left / spread if spread > 0 else np.nan
    times = float(np.sqrt(noise / told)) if told else np.nan
    misfit = work > (WITHOUT_NOISE if np.isnan(times) else SHARE) and not times <= TIMES
    if fit.motion is not None and fit.found.get("noise_u"):
        by_motion = left_by(shown, fit)
        times, misfit = by_motion.times, misfit or by_motion.misfit
    times = np.nan if silent else times
    unknown = _unknown(courses, fit)
    warnings = (*(_of_misfit(fit, work, times) if misfit else ()), *_of_unknown(unknown))
    unread = next((one.columns(one.unread) for one in shown if one.unread), "")
    return Adequacy(work, r2, times, not warnings, warnings, unknown, unread, silent)


def _at_places(data: Sequence[Samples], fit: Fit) -> tuple[list[Samples], Fit]:
    """Return windows of long chains at places that a seed chooses, and a fit that has its motion there."""
    parts: list[Samples] = []
    motions: list[Samples] = []
    draw, reach = np.random.default_rng(SEED), fit.library.reach
    for number, samples in enumerate(data):
        for begin in draw.integers(reach[0], samples.sites - WINDOW - reach[1], PLACES, endpoint=True).tolist():
            parts.append(window(samples, reach, begin, begin + WINDOW).samples)
            if fit.motion is not None:
                motions.append(window(fit.motion[number], reach, begin, begin + WINDOW).samples)
    return parts, replace(fit, motion=tuple(motions) if motions else None)


@dataclass(frozen=True, eq=False)
class _Course:
    """A recording with the states of its sites, and its equation set up between them."""

    samples: Samples
    states: Float[ndarray, "time state"]
    stretches: Stretches
    splines: Float[ndarray, "spline parts border"] | None

    @functools.cached_property
    def places(self) -> tuple[ndarray, int]:
        """Where the equation is followed from, and for how many samples."""
        ahead = _ahead(self.samples)
        return np.unique(np.linspace(0, len(self.states) - 1 - ahead, MOST).round().astype(int)), ahead

    def rates(self, order: int) -> Float[ndarray, "parts place site"]:
        """Return the derivative of that order at the places, by a smoothing spline through the readings."""
        field = split_parts(self.samples.u, self.samples.is_complex)
        found = [differentiate(self.samples.t, field[:, part], "smoothing-spline") for part in range(field.shape[1])]
        rate = np.stack([one.second if order == 2 else one.first for one in found])
        return np.asarray(rate[:, self.places[0]][..., self.stretches.dynamics.moving])


def _course(samples: Samples, fit: Fit, number: int) -> _Course:
    from scipy.interpolate import make_interp_spline

    dynamics = Dynamics(fit.library.terms, fit.order, samples.is_complex, samples.sites, samples.ends)
    u, v = smooth(samples, fit.order)
    if samples.unread:
        moved, there = motion_of(samples, fit, number), list(samples.unread)
        for field, level in ((u, 0), (v, 1))[: fit.order]:
            if field is not None:
                made = moved[:, level, 0] + (1j * moved[:, level, 1] if samples.is_complex else 0.0)
                field[:, there] = np.where(np.isfinite(made), made, field)[:, there]
    drive, splines = None, None
    if len(dynamics.border):
        # Sites without an equation move as they were read.
        curve = make_interp_spline(samples.t, split_parts(u[:, dynamics.border], samples.is_complex), k=3)
        drive, splines = BSplines(curve.t, 3), curve.c
    inputs = samples.forcing() if fit.library.uses("f") else None
    stretches = Stretches(dynamics, samples.t[:-1], samples.t[1:], inputs, drive, held=True)
    return _Course(samples, dynamics.pack(u, v), stretches, splines)


def _followed(course: _Course, fit: Fit) -> _Sums:
    """Follow the equation over half a period from many places of one recording."""
    samples, states, dynamics = course.samples, course.states, course.stretches.dynamics
    t, (begin, ahead) = samples.t, course.places
    found = _integrated(course.stretches, t, states, (begin, ahead), fit.coefficients, course.splines)
    shape = (len(begin), dynamics.order, dynamics.parts, dynamics.count)
    free = states[begin].reshape(shape)[:, 0].copy()
    if dynamics.order == 2:
        free += states[begin].reshape(shape)[:, 1] * (t[begin + ahead] - t[begin])[:, None, None]
    read = split_parts(samples.u, samples.is_complex)[..., dynamics.moving]
    seen = read[begin + ahead]
    known = np.isfinite(seen)
    middle = np.nansum(read, axis=0) / np.maximum(np.sum(np.isfinite(read), axis=0), 1)
    away = AWAY * float(np.nanmax(np.abs(seen - middle), initial=0.0))
    wrong = np.nan_to_num(found.reshape(shape)[:, 0] - seen, nan=away, posinf=away, neginf=away)
    wrong = np.where(known, np.clip(wrong, -away, away), 0.0)
    shown, silent = of_sensors(t, samples.u)
    noise = shown[dynamics.moving]
    told = known & np.isfinite(noise) & (noise > 0)
    parts = [
        wrong**2, np.nan_to_num(free - seen) ** 2, np.nan_to_num(seen - middle) ** 2,
        np.where(told, wrong / np.where(noise > 0, noise, 1.0), 0.0) ** 2, told,
    ]  # fmt: skip
    sums = (np.sum(one, axis=(1, 2), dtype=float) for one in parts)
    return _Sums(np.full(len(begin), silent), *sums)


def _integrated(
    stretches: Stretches,
    t: ndarray,
    states: ndarray,
    places: tuple[ndarray, int],
    coefficients: ndarray,
    splines: ndarray | None,
) -> Float[ndarray, "place state"]:
    """Return the states so many samples after those at `begin`; infinite where they have run away."""
    begin, ahead = places
    levels = states.reshape(len(states), stretches.dynamics.order, -1)
    # That of u and of v: some sites hardly move.
    size = np.broadcast_to(np.max(np.std(levels, axis=0), axis=1)[:, None] + TINY, levels.shape[1:]).ravel()
    far = AWAY * np.max(np.abs(states))
    found = states[begin].copy()
    near = np.arange(len(begin))
    # In short stretches, since one that is unbounded in a single step is given up.
    for one, other in itertools.pairwise(np.unique(np.linspace(0, ahead, HOPS + 1).round().astype(int))):
        hop = replace(stretches, begin=t[begin[near] + one], end=t[begin[near] + other])
        with np.errstate(all="ignore"):
            substeps = hop.substeps(coefficients, found[near], TOLERANCE * size, splines, STEPS)
            found[near] = hop.run(coefficients, found[near], substeps, splines)
            away = ~np.all(np.abs(found[near]) < far, axis=1)
        found[near[away]] = np.inf
        near = near[~away]
        if not len(near):
            break
    return np.asarray(found)


def _ahead(samples: Samples) -> int:
    """Return how many samples half a period of the strongest line is long."""
    peaks = Spectrum.of(samples).peaks
    step = float(np.median(np.diff(samples.t)))
    half = np.pi / float(peaks[0]) / step if len(peaks) and peaks[0] > 0 else len(samples.t) / 10
    return int(np.clip(round(half), 1, max(len(samples.t) // 3, 1)))


def _unknown(courses: Sequence[_Course], fit: Fit) -> tuple[str, ...]:
    """Return the terms whose coefficients the readings do not determine.

    Where a method gives no standard errors they are those of a regression of the derivative on the terms it has kept.
    That may be far worse than what the method does, so that only terms count which nearly cancel each other.
    """
    kept = fit.coefficients != 0
    squares, force, count = np.zeros(len(fit.library.terms)), 0.0, 0
    products, left, equations = np.zeros((len(kept), len(kept))), 0.0, 0
    for one in courses:
        t, stretches = one.samples.t[one.places[0]], one.stretches
        f = None if stretches.inputs is None else stretches.inputs(t)
        driven = stretches.driven(t, one.splines)
        with np.errstate(all="ignore"):
            values = stretches.dynamics.linear(
                fit.coefficients, t, one.states[one.places[0]], f, driven, derivatives=False
            )[1]
            squares += np.sum(np.nan_to_num(values) ** 2, axis=(0, 2, 3))
            forces = np.tensordot(fit.coefficients, values, (0, 1))
            force += float(np.sum(np.nan_to_num(forces) ** 2))
        count += values[:, 0].size
        if fit.stderr is None:
            rates = one.rates(fit.order)
            known = np.isfinite(rates) & np.isfinite(forces)
            rows = np.moveaxis(values, 1, -1)[known]
            products += rows.T @ rows
            left, equations = left + float(np.sum((rates - forces)[known] ** 2)), equations + len(rows)
    with np.errstate(all="ignore"):
        scale = np.sqrt(squares / count)
        most = UNKNOWN * np.sqrt(force / count) + TINY
        if fit.stderr is None:
            of_kept = np.linalg.pinv(products[np.ix_(kept, kept)], hermitian=True).diagonal()
            errors = np.zeros(len(kept))
            errors[kept] = np.sqrt(np.abs(of_kept) * left / max(equations - int(np.sum(kept)), 1))
            lost = (scale * errors > most) & (scale * np.abs(fit.coefficients) > most)
        else:
            lost = scale * np.nan_to_num(fit.stderr, nan=np.inf) > most
    return tuple(text for text, unsure in zip(fit.library.texts, lost, strict=True) if unsure)


def _of_unknown(terms: Sequence[str]) -> tuple[str, ...]:
    if not terms:
        return ()
    listed = ", ".join(terms) if len(terms) <= LISTED else f"{', '.join(terms[:LISTED])} and others"
    return (
        f"the readings do not determine the coefficients of {listed}: their standard errors are worth more than "
        f"{UNKNOWN:g} times all forces together; leave terms out, or read more",
    )


def _of_misfit(fit: Fit, work: float, times: float) -> tuple[str, ...]:
    beyond = "" if np.isnan(times) else f", {two_digits(times)} times the noise of the readings"
    lines = [
        f"the equation does not fit: over half a period it leaves {two_digits(100 * min(work, AWAY))} % of what the "
        f"forces do{beyond}; `latticebench diagnose` looks for what it lacks"
    ]
    if fit.stderr is not None:
        lines.append("standard errors hold for a right equation only; here they mean nothing")
    return tuple(lines)
