"""Samples: what was observed of a lattice's motion, measured or simulated."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, get_args

import numpy as np

from latticebench.systems.arrays import rows_of
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import Library
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term, express

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Beyond it the square of the cube of a value is more than double precision holds; nothing can be fitted to it.
LARGEST_VALUE = 1e50

# Columns that a message names, at most.
LISTED = 5


@dataclass(frozen=True)
class Origin:
    """How samples were read from a file: the units and names that it has. Numbers are in the units of the equation.

    Attributes:
        time: unit of the times; "" where it is not known.
        unit: unit of the readings in the file; "" where it is not known.
        scale: what one unit of a reading is in the equation: u = scale * reading.
        becomes: unit of u in the equation; "" where it is not known.
        columns: names of the sensors' columns; () where they are u1, u2, ...
        notes: what else a user should know of the reading, a part of a sentence each.
    """

    time: str = ""
    unit: str = ""
    scale: float = 1.0
    becomes: str = ""
    columns: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def noting(self, *notes: str) -> Origin:
        """Return the same with more to know."""
        return replace(self, notes=(*self.notes, *notes))


@dataclass(frozen=True, eq=False)
class Samples:
    """What was observed of one trajectory.

    Attributes:
        t: times (T,), increasing, not necessarily evenly spaced.
        u: the field (T, N), real or complex; NaN where a value is missing.
        v: its velocity (T, N), or None if it was not observed.
        f: the measured input (T, N), or None.
        sigma: standard deviation of the noise on u, or None if it is not known.
        source: the file or simulation that they come from.
        ends: how the chain ends, as far as this is known.
        origin: how they were read.

    Raises:
        InputError: shapes differ, times do not increase, or there is nothing to fit.
    """

    t: Float[ndarray, " time"]
    u: Float[ndarray, "time sites"]
    v: Float[ndarray, "time sites"] | None = None
    f: Float[ndarray, "time sites"] | None = None
    sigma: float | None = None
    source: str = "samples"
    ends: Ends = "unknown"
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        """Check shapes, times and values, and protect the arrays from changes."""
        where = self.source
        for name in ("t", "u", "v", "f"):
            if getattr(self, name) is not None:
                # A view: whoever made the array may go on writing to it.
                kept = np.asarray(getattr(self, name)).view()
                kept.setflags(write=False)
                object.__setattr__(self, name, kept)
        if self.t.ndim != 1 or self.u.ndim != 2 or self.u.shape[0] != len(self.t):
            raise InputError(f"{where}: t has shape {self.t.shape} and u {self.u.shape}; they must be (T,) and (T, N)")
        if len(self.t) < 2:
            raise InputError(f"{where}: it has {len(self.t)} row(s) of data; a motion needs at least 2")
        if self.u.shape[1] < 1:
            raise InputError(f"{where}: it has no sites; give columns u1, u2, ...")
        self._check_times()
        for name in ("u", "v", "f"):
            if getattr(self, name) is not None:
                self._check_field(name)
        if all(np.all(np.isnan(self.u[some])) for some in rows_of(self.u)):
            raise InputError(f"{where}: every value of u is missing")
        if self.sigma is not None and not (np.isfinite(self.sigma) and self.sigma >= 0):
            raise InputError(f"{where}: sigma is {self.sigma!r}; a standard deviation is a number >= 0")
        if self.ends not in get_args(Ends):
            raise unknown("ends", str(self.ends), get_args(Ends), where)

    def _check_times(self) -> None:
        """Refuse times that are not finite or do not increase."""
        where = self.source
        sound = np.abs(self.t) <= LARGEST_VALUE
        if not np.all(sound):
            row = int(np.flatnonzero(~sound)[0])
            told = f"beyond {LARGEST_VALUE:g}" if np.isfinite(self.t[row]) else "missing or not finite"
            raise InputError(f"{where}: row {row + 1}, column t: the time is {told}; fill it in or leave the row out")
        steps = np.diff(self.t)
        if np.any(steps <= 0):
            row = int(np.flatnonzero(steps <= 0)[0]) + 1
            raise InputError(
                f"{where}: row {row + 1}, column t: time {self.t[row]:g} after {self.t[row - 1]:g}; "
                "times must increase: sort the rows, or give several trajectories a column 'trajectory'"
            )
        if np.any(steps < 1 / LARGEST_VALUE):
            row = int(np.flatnonzero(steps < 1 / LARGEST_VALUE)[0]) + 1
            raise InputError(
                f"{where}: row {row + 1}, column t: it is {steps[row - 1]:g} after the row before, less than "
                f"{1 / LARGEST_VALUE:g}; give times in a smaller unit"
            )

    def _check_field(self, name: str) -> None:
        """Refuse a field of another shape or kind than u, or with infinite or absurdly large values."""
        where, array = self.source, getattr(self, name)
        if array.shape != self.u.shape:
            raise InputError(
                f"{where}: u has {self.u.shape[1]} sites in {self.u.shape[0]} rows, {name} has shape {array.shape}; "
                "they must be the same"
            )
        if np.iscomplexobj(array) and (name == "f" or not np.iscomplexobj(self.u)):
            raise InputError(f"{where}: {name} is complex; it must be real{'' if name == 'f' else ' as u is'}")
        for some in rows_of(array):
            # Not by the absolute value of a complex number, which overflows.
            parts = (array[some].real, array[some].imag)
            wrong = (np.abs(parts[0]) > LARGEST_VALUE) | (np.abs(parts[1]) > LARGEST_VALUE)
            if not np.any(wrong):
                continue
            row, site = (int(k) for k in np.argwhere(wrong)[0])
            told = "infinite" if np.isinf(array[some][row, site]) else f"beyond {LARGEST_VALUE:g}"
            raise InputError(
                f"{where}: row {row + some.start + 1}, column {name}{site + 1}: {told}; leave the cell empty if the "
                "value is missing, or choose a larger unit"
            )

    @property
    def sites(self) -> int:
        """The number of sites N."""
        return int(self.u.shape[1])

    @property
    def is_complex(self) -> bool:
        """Whether the field is complex."""
        return bool(np.iscomplexobj(self.u))

    @property
    def is_even(self) -> bool:
        """Whether the times are evenly spaced, to a thousandth of a step."""
        steps = np.diff(self.t)
        return bool(np.ptp(steps) <= 1e-3 * np.mean(steps))

    @functools.cached_property
    def has_missing(self) -> bool:
        """Whether any value is NaN."""
        arrays = [array for array in (self.u, self.v, self.f) if array is not None]
        return any(bool(np.any(np.isnan(array[some]))) for array in arrays for some in rows_of(array))

    @functools.cached_property
    def unread(self) -> tuple[int, ...]:
        """The sites, from 0, at which neither u nor v was ever read."""
        seen = np.zeros(self.sites, dtype=bool)
        for array in (one for one in (self.u, self.v) if one is not None):
            for some in rows_of(array):
                seen |= ~np.all(np.isnan(array[some]), axis=0)
        return tuple(np.flatnonzero(~seen).tolist())

    def columns(self, sites: Sequence[int]) -> str:
        """Return the names that the readings of some sites have in their file, as a list in words."""
        known = self.origin.columns
        named = [known[one] if known else f"{'re' if self.is_complex else 'u'}{one + 1}" for one in sites[:LISTED]]
        return ", ".join([*named, *([f"{len(sites) - LISTED} others"] if len(sites) > LISTED else [])])

    def forcing(self, degree: int = 3) -> Callable[[ndarray], ndarray]:
        """Return the measured input as a function of times (B,), with values (B, N).

        At each site it is a spline through the samples, after gaps have been bridged by straight lines: cubic, or of
        another odd degree, or of degree 0, which holds each value until the next one.

        Raises:
            InputError: no input was measured, or all its values at a site are missing.
        """
        from scipy.interpolate import make_interp_spline

        if self.f is None:
            raise InputError(f"{self.source}: there is no measured input f or f1..f{self.sites}")
        f = self.f.real.copy()
        for site in range(f.shape[1]):
            seen = np.isfinite(f[:, site])
            if not np.any(seen):
                raise InputError(f"{self.source}: the measured input of site {site + 1} is missing throughout")
            f[~seen, site] = np.interp(self.t[~seen], self.t[seen], f[seen, site])
        curve: Callable[[ndarray], ndarray] = make_interp_spline(
            self.t, f, k=min(degree, (len(self.t) - 2) // 2 * 2 + 1)
        )
        return curve

    def of_rows(self, rows: slice) -> Samples:
        """Return the samples at some of the times."""
        v, f = (None if field is None else field[rows] for field in (self.v, self.f))
        return replace(self, t=self.t[rows], u=self.u[rows], v=v, f=f)

    def mirrored(self) -> Samples:
        """Return the samples of -u, which solves an equation of odd terms, too."""
        return replace(self, u=-self.u, v=None if self.v is None else -self.v, f=None if self.f is None else -self.f)


@dataclass(frozen=True, eq=False)
class SimulatedSamples(Samples):
    """Samples that know their truth; methods are given `observed()`, which does not.

    Attributes:
        equation: the true right-hand side, with numbers.
        exact: the same trajectory without noise and with nothing missing.
        rate: its highest derivative (T, N): du/dt for first order, d^2u/dt^2 for second.
        noise: the noise level: sigma over the RMS of the field about its mean.
    """

    equation: str = ""
    exact: Samples | None = None
    rate: Float[ndarray, "time sites"] | None = None
    noise: float = 0.0

    def of_rows(self, rows: slice) -> SimulatedSamples:
        """Return the samples at some of the times with their truth."""
        part = super().of_rows(rows)
        assert isinstance(part, SimulatedSamples)
        exact, rate = self.exact, self.rate
        return replace(part, exact=exact and exact.of_rows(rows), rate=None if rate is None else rate[rows])

    def mirrored(self) -> SimulatedSamples:
        """Return the samples of -u with their truth.

        Raises:
            InputError: the equation is not odd, so that -u does not solve it.
        """
        if Term(self.equation).parity != -1:
            raise InputError(
                f"{self.source}: the equation is not odd, so that -u does not solve it; leave the mirrored data out"
            )
        mirrored = super().mirrored()
        assert isinstance(mirrored, SimulatedSamples)
        exact = None if self.exact is None else self.exact.mirrored()
        return replace(mirrored, exact=exact, rate=None if self.rate is None else -self.rate)

    def observed(self) -> Samples:
        """Return what an experiment would have: no truth, and unknown noise."""
        return Samples(self.t, self.u, self.v, self.f, None, "simulated samples", self.ends)

    def truth(self, candidates: Library) -> Float[ndarray, " terms"] | None:
        """Return the true coefficients over a library, or None if the equation is outside its span."""
        return express(Term(self.equation), candidates.terms, self.is_complex)


def check_alike(data: Sequence[Samples]) -> None:
    """Check that there are trajectories, and that all have the same sites and observed quantities.

    Raises:
        InputError: there are none, or two that differ.
    """
    if not data:
        raise InputError("no samples are given; give at least one file or trajectory")
    first = data[0]
    for samples in data[1:]:
        if samples.sites != first.sites:
            raise InputError(
                f"{samples.source}: it has {samples.sites} sites, {first.source} has {first.sites}; fit them apart"
            )
        if samples.is_complex != first.is_complex:
            raise InputError(
                f"{samples.source}: one of it and {first.source} is real, the other complex; fit them apart"
            )
        for name in ("v", "f"):
            if (getattr(samples, name) is None) != (getattr(first, name) is None):
                raise InputError(
                    f"{samples.source}: only one of it and {first.source} has columns {name}1..{name}N; fit them apart"
                )


def check_units(data: Sequence[Samples]) -> None:
    """Check that times, readings, and u in the equation have the same units in all trajectories.

    Raises:
        InputError: two of them differ.
    """
    named = {"time": "times", "unit": "readings", "becomes": "scaled readings"}
    for samples in data[1:]:
        for name, what in named.items():
            own, first = (getattr(one.origin, name) or "no unit" for one in (samples, data[0]))
            if own != first:
                raise InputError(
                    f"{samples.source}: {what} in {own}, those of {data[0].source} in {first}; read them apart, or "
                    "bring them to one unit"
                )
