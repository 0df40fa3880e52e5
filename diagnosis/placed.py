"""An effect of the catalogue in its place: what it adds to the equation, and what it makes of the readings."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.dynamics import Factor
from latticebench.systems.effects import INSTRUMENT, Effect
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Parameters that are found by the search and then kept.
KEPT = ("s", "open", "reach", "step", "inner", "origin", "whole")


@functools.lru_cache(maxsize=512)
def read_term(text: str) -> Term:
    """Return the term of a text; each text is parsed once."""
    return Term(text)


@dataclass(frozen=True, eq=False)
class Force:
    """One term of the right-hand side with where and when it acts; see `methods.engine.dynamics.Dynamics`."""

    term: Term
    weights: Float[ndarray, " sites"] | None = None
    factor: Factor | None = None
    label: str = ""


@dataclass(frozen=True, eq=False)
class PlacedEffect:
    """An effect in its place, as a candidate has it and as a model holds it.

    Attributes:
        effect: of the catalogue.
        texts: its terms on this lattice.
        psi: the parameters that are not coefficients, by name, as far as they are fitted.
        site: where it acts (0, ..., N-1), or None.
        ends: how the chain ends instead.
        past: the field of each record at earlier times, for effects that need it: (B, N) at times (B,).
        both: a sensor's error is in u and v alike.
        as_force: a sensor's offset written as what it does to the equation, a constant force at each site; a linear
            chain cannot tell the two apart, and the force can be found before the coefficients are right.
        spread: standard deviation that the parameters have among themselves, for random ones; None for any size.
        effective: how many numbers random parameters amount to, held together as they are by their spread.
    """

    effect: Effect
    texts: tuple[str, ...] = ()
    psi: Mapping[str, float] = field(default_factory=dict)
    site: int | None = None
    ends: Ends | None = None
    past: tuple[Factor, ...] = ()
    both: bool = False
    as_force: bool = False
    spread: float | None = None
    effective: float | None = None

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters that a fit changes."""
        return () if self.as_force else tuple(name for name in self.psi if name not in KEPT)

    def moved(self, psi: Mapping[str, float]) -> PlacedEffect:
        """Return the same with other values of some parameters."""
        return replace(self, psi={**self.psi, **{name: value for name, value in psi.items() if name in self.psi}})

    def forces(self, sites: int, is_complex: bool, record: int = 0) -> list[Force]:
        """Return the terms that it adds to the right-hand side, on the chain of one record."""
        acts, psi = self.effect.acts, self.psi
        if self.as_force:
            return [Force(read_term("1"), row, None, f"1 at site {k + 1}") for k, row in enumerate(np.eye(sites))]
        if acts in INSTRUMENT or acts in ("one equation", "ends"):
            return []
        if acts == "harmonic":
            omega = psi["omega"]
            waves = (
                ("cos", lambda t: np.cos(omega * t)[None, :, None]),
                ("sin", lambda t: np.sin(omega * t)[None, :, None]),
            )
            return [
                Force(read_term(text), None, wave, f"{name}({omega:.6g}*t)" + ("" if text == "1" else f"*{text}"))
                for text in self.texts
                for name, wave in waves
            ]
        if acts == "pulse":
            at, width = psi["at"], psi["width"]

            def pulse(t: ndarray) -> ndarray:
                return np.asarray(np.exp(-(((t - at) / width) ** 2) / 2)[None, :, None])

            shape = f"exp(-((t-{at:.6g})/{width:.6g})**2/2)"
            return [
                Force(read_term(text), None, pulse, shape + ("" if text == "1" else f"*{text}")) for text in self.texts
            ]
        if acts == "delayed":
            return _delayed(self.past[min(record, len(self.past) - 1)], psi["delay"], is_complex)[: len(self.texts)]
        if acts == "long range":
            text = _far_text(psi, sites)
            label = f"sum over r>=2 of (u[n+r]+u[n-r]-2*u[n])/r**{psi['s']:.4g}"
            whole = [Force(read_term(text), label=label), Force(read_term(f"i*({text})"), label=f"i*{label}")]
            return whole[: len(self.texts)]
        if acts == "alternating":
            sign = np.where(np.arange(sites) % 2 == 0, 1.0, -1.0)
            return [Force(read_term(text), sign, None, f"(-1)**k*{text}") for text in self.texts]
        if acts == "one site":
            assert self.site is not None
            return [Force(read_term(text), np.eye(sites)[self.site], None, text) for text in self.texts]
        if acts == "every site":
            each = np.eye(sites)
            if not self.psi.get("whole"):
                # Deviations from their mean, which the model has already: the last site's is what makes their sum 0.
                each = each[:-1] - each[-1]
            return [
                Force(read_term(text), row, None, f"{text} at site {k + 1}")
                for text in self.texts
                for k, row in enumerate(each)
            ]
        return [Force(read_term(text), label=text) for text in self.texts]

    def scales(self, sites: int) -> ndarray | None:
        """Return the factor of each site's whole right-hand side, or None where it has none."""
        if self.effect.acts != "one equation":
            return None
        factor = np.ones(sites)
        factor[self.site] += self.psi["scale"]
        return factor

    def misreading(
        self, t: Float[ndarray, " time"], field: Float[ndarray, "time levels parts sites"], rate: ndarray
    ) -> Float[ndarray, "time levels parts sites"]:
        """Return what the instrument adds to the readings of a field whose time derivative is `rate`."""
        wrong = np.zeros_like(field)
        if self.effect.acts == "rounding":
            wrong[:, :1] = rounding_error(field[:, :1], self.psi["step"], self.psi["inner"], self.psi["origin"])
        for name in self.free:
            value = self.psi[name]
            wrong += value * self.misreading_by(name, t, field, rate)
        return wrong

    def misreading_by(self, name: str, t: ndarray, field: ndarray, rate: ndarray) -> ndarray:
        """Return the derivative of the misreading by one parameter; all of them enter linearly."""
        acts = self.effect.acts
        column = np.zeros_like(field)
        kind, _, number = name.partition("_")
        where = slice(None) if not number else int(number) - 1
        levels = slice(None) if self.both else slice(0, 1)
        if acts == "offset":
            part = 1 if kind == "imaginary" else 0
            column[:, 0, part, where] = 1.0
        elif acts == "gain":
            column[:, levels, :, where] = field[:, levels, :, where]
        elif acts == "curve":
            u = field[:, 0]
            if u.shape[1] == 1:
                column[:, 0, 0, where] = u[:, 0, where] ** 2
                if self.both and field.shape[1] > 1:
                    column[:, 1, 0, where] = 2 * u[:, 0, where] * field[:, 1, 0, where]
            else:
                column[:, 0, :, where] = np.hypot(u[:, 0], u[:, 1])[:, None, where] * u[:, :, where]
        elif acts == "clock":
            if kind == "rate":
                column[:] = (t - t[0])[:, None, None, None] * rate
            else:
                row = int(number) - 1
                column[row : row + 1] = rate[row : row + 1]
        return column


def _far_text(psi: Mapping[str, float], sites: int) -> str:
    """Return the long-range coupling as a term: with what the ends repeat, or (open) between the sites alone."""
    terms = []
    for r in range(2, int(psi["reach"]) + 1):
        strength = f"{r ** -psi['s']:.10g}"
        if not psi["open"]:
            terms.append(f"{strength}*(u[n+{r}]+u[n-{r}]-2*u[n])")
            continue
        # A site beyond the end does not pull: (1 + sign) / 2 is 1 inside and 0 outside.
        last = (sites - 1) / 2 + 0.25 - r
        terms.append(f"{strength}/2*((1+sign({last}-n))*(u[n+{r}]-u[n])+(1+sign({last}+n))*(u[n-{r}]-u[n]))")
    return " + ".join(terms)


def far_matrix(psi: Mapping[str, float], sites: int) -> Float[ndarray, "sites sites"]:
    """Return the open long-range coupling as a matrix."""
    distance = np.abs(np.subtract.outer(np.arange(sites), np.arange(sites))).astype(float)
    pull = np.zeros((sites, sites))
    far = (distance >= 2) & (distance <= psi["reach"])
    pull[far] = distance[far] ** -psi["s"]
    return pull - np.diag(pull.sum(axis=1))


def rounding_error(field: ndarray, step: float, inner: float, origin: float) -> ndarray:
    """Return the mean error of readings rounded to origin + k * step, the field having noise of the size `inner`.

    The Fourier series of the sawtooth, damped by the noise (Widrow & Kollar, Quantization Noise (2008), chapter 4).
    """
    phase = 2 * np.pi * (field - origin) / step
    waves = (
        (-1) ** k * step / (np.pi * k) * np.exp(-2 * (np.pi * k * inner / step) ** 2) * np.sin(k * phase)
        for k in range(1, 30)
    )
    return np.asarray(sum(waves))


def _delayed(past: Factor, delay: float, is_complex: bool) -> list[Force]:
    """Return the field as it was, and i times it: known functions of time."""
    label = f"u[n] at t-{delay:.6g}"
    if not is_complex:
        return [Force(read_term("1"), None, lambda t: past(t - delay)[None], label)]

    def now(t: ndarray) -> ndarray:
        field = past(t - delay)
        return np.stack([field.real, field.imag])

    def turned(t: ndarray) -> ndarray:
        field = past(t - delay)
        return np.stack([-field.imag, field.real])

    return [Force(read_term("1+i"), None, now, label), Force(read_term("1+i"), None, turned, f"i*({label})")]
