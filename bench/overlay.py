"""Readings of a chain, and beside them the motion of equations that were fitted to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.instrument import of_readings
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.engine.record import prepare, without_halves
from latticebench.methods.engine.sensitivity import MAX_SUBSTEPS
from latticebench.methods.engine.shooting import State, maximise
from latticebench.methods.engine.starts import guess, smooth
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Origin, Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.methods.engine.record import Record
    from latticebench.methods.method import Fit, History

# Numbers of u that a picture shows of a recording with a fit, at most, and the fewest rows that it begins with.
MOST_NUMBERS, FEWEST_ROWS = 20_000, 200
# Steps in which the start of a motion is fitted, and how closely.
STEPS, CLOSE = 20, 0.1
# Records of a method's learning that a picture shows, at most.
MOST_RECORDS = 300
# Parts of an interval in which a motion is integrated that no start was found for.
SUBSTEPS = 8


@dataclass(frozen=True)
class Learning:
    """The coefficients of a method on the way to its fit.

    Attributes:
        terms: whose coefficients.
        history: the way.
    """

    terms: tuple[str, ...]
    history: History


@dataclass(frozen=True, eq=False)
class Overlay:
    """Readings of one recording, and curves beside them.

    Attributes:
        source: where the readings come from.
        rows: how many rows the recording has; the first of them are shown.
        t: times (T,).
        seen: readings of u (T, parts, N), real parts before imaginary ones, NaN where nothing was read.
        velocity: readings of v likewise, or None.
        noise: standard deviation of the noise of each site, in the units of u, of each part of a complex field; None
            where it is not known.
        curves: what equations make of the readings, likewise, by name; NaN where nothing is known.
        unit, time_unit: of the readings and of the times; "" where they are not known.
        learning: how the coefficients were found, of a method that iterates and has kept it.
    """

    source: str
    rows: int
    t: Float[ndarray, " time"]
    seen: Float[ndarray, "time parts sites"]
    velocity: Float[ndarray, "time parts sites"] | None = None
    noise: Float[ndarray, " sites"] | None = None
    curves: Mapping[str, Float[ndarray, "time parts sites"]] = field(default_factory=dict)
    unit: str = ""
    time_unit: str = ""
    learning: Learning | None = None

    @property
    def sites(self) -> int:
        """The number of sites N."""
        return int(self.seen.shape[2])

    @property
    def is_complex(self) -> bool:
        """Whether the field is complex."""
        return bool(self.seen.shape[1] == 2)

    def residual(self, name: str) -> Float[ndarray, "time parts sites"]:
        """Return readings less a curve, in units of the noise where that is known."""
        left = self.seen - self.curves[name]
        return np.asarray(left if self.noise is None else left / self.noise)

    def moving(self, count: int) -> list[int]:
        """Return the `count` sites that move most, from 0 and in their order."""
        spread = np.nan_to_num(np.nanvar(self.seen, axis=0).sum(axis=0))
        return sorted(np.argsort(-spread, kind="stable")[:count].tolist())

    def rates(self) -> Float[ndarray, "time parts sites"]:
        """Return the velocities: as they were read, else the slopes of smoothing splines through u."""
        if self.velocity is not None:
            return self.velocity
        parts = [smooth(Samples(self.t, self.seen[:, k]), 2)[1] for k in range(self.seen.shape[1])]
        return np.stack([one for one in parts if one is not None], axis=1)

    def read_as(self, origin: Origin) -> Overlay:
        """Return the same in the unit of the file, where that is known; it is in that of the equation."""
        if not origin.unit:
            return replace(self, time_unit=origin.time)
        size = origin.scale
        return replace(
            self, seen=self.seen / size, velocity=None if self.velocity is None else self.velocity / size,
            noise=None if self.noise is None else self.noise / abs(size),
            curves={name: one / size for name, one in self.curves.items()}, unit=origin.unit, time_unit=origin.time,
        )  # fmt: skip


def of_recording(samples: Samples) -> Overlay:
    """Return the readings of a recording alone."""
    return _read(samples).read_as(samples.origin)


def _read(samples: Samples) -> Overlay:
    v = None if samples.v is None else split_parts(samples.v, samples.is_complex)
    return Overlay(
        samples.source, len(samples.t), samples.t, split_parts(without_halves(samples).u, samples.is_complex), v
    )


def of_fit(data: Sequence[Samples], fit: Fit) -> Overlay:
    """Return the recording that a fit leaves most of, with the motion of its equation that is nearest to the readings.

    A method that follows a motion has it. Of any other the equation is taken as it was found, and its start, with what
    comes in at unknown ends, is fitted to the readings.
    """
    learning = None if fit.history is None else Learning(fit.library.texts, fit.history.thinned(MOST_RECORDS))
    found = [
        replace(_beside(one, fit, number).read_as(one.origin), learning=learning) for number, one in enumerate(data)
    ]

    def left(one: Overlay) -> float:
        return float(np.nan_to_num(np.nanmean(one.residual(fit.method) ** 2), nan=np.inf))

    return max(found, key=left)


def _beside(samples: Samples, fit: Fit, number: int) -> Overlay:
    shown = _first(samples)
    curve = motion_of(shown, fit, number)[:, 0]
    # Not what the fit leaves: a wrong equation would be taken for noise.
    noise = of_readings(samples.t, samples.u)
    known = noise if np.all(np.isfinite(noise)) and np.all(noise > 0) else None
    return replace(_read(shown), rows=len(samples.t), velocity=None, noise=known, curves={fit.method: curve})


def _first(samples: Samples) -> Samples:
    """Return the rows of a recording that are shown."""
    return samples.of_rows(slice(max(FEWEST_ROWS, MOST_NUMBERS // (samples.sites * (1 + samples.is_complex)))))


def motion_of(samples: Samples, fit: Fit, number: int) -> Float[ndarray, "time order parts sites"]:
    """Return u and, for order 2, v of a fit along the first rows of its recording of that number.

    A method that follows a motion has it. Of any other the equation is taken as it was found, and its start is fitted
    to the readings; NaN from where it cannot be followed.
    """
    if fit.motion is not None:
        found = fit.motion[number]
        fields = [found.u] if fit.order == 1 or found.v is None else [found.u, found.v]
        return np.stack([split_parts(one[: len(samples.t)], samples.is_complex) for one in fields], axis=1)
    return _nearest(samples, fit)


def _nearest(samples: Samples, fit: Fit) -> Float[ndarray, "time order parts sites"]:
    """Return the motion of a fit's equation that is nearest to readings; NaN from where it cannot be followed."""
    with np.errstate(all="ignore"):
        try:
            record = prepare(samples, fit.library.terms, fit.order)
            start = replace(guess([samples], [record]), coefficients=np.asarray(fit.coefficients, dtype=float))
            stiff = _is_stiff(record, start)
            found = None if stiff else maximise([record], start, steps=STEPS, tolerance=CLOSE, held=True)
        except (InputError, np.linalg.LinAlgError):
            # There are too few readings for a start, or the equation runs away from every one.
            return np.full((len(samples.t), fit.order, 1 + samples.is_complex, samples.sites), np.nan)
        near = found.state if found is not None and found.converged else start
        nodes = _followed(record, start) if near is start else near.nodes[0]
        driven = record.stretches.driven(record.times, near.splines[0])
        return np.asarray(record.stretches.dynamics.whole(nodes, driven))


def _is_stiff(record: Record, state: State) -> bool:
    """Return whether an equation moves too fast, from one reading to the next, for a start to be fitted."""
    size = np.nanstd(state.nodes[0], axis=0)
    needed = record.stretches.substeps(state.coefficients, state.nodes[0][:-1], CLOSE * size, state.splines[0])
    return bool(np.max(needed) >= MAX_SUBSTEPS)


def _followed(record: Record, state: State) -> Float[ndarray, "time state"]:
    """Integrate an equation from the first node of a state, as far as it goes."""
    nodes, stretches = np.full(state.nodes[0].shape, np.nan), record.stretches
    nodes[0] = state.nodes[0][0]
    for k in range(len(nodes) - 1):
        one = replace(stretches, begin=stretches.begin[k : k + 1], end=stretches.end[k : k + 1], held=True)
        end = one.run(state.coefficients, nodes[k : k + 1], np.full(1, SUBSTEPS), state.splines[0])[0]
        if not np.all(np.isfinite(end)):
            break
        nodes[k + 1] = end
    return nodes


def of_diagnosis(diagnosis: Diagnosis) -> Overlay:
    """Return the recording that the declared equation leaves most of, with what both equations make of it."""
    before, after = diagnosis.before.curves(), diagnosis.after.curves()
    left = [float(np.nanmean(((one.seen - one.level)[:, 0] / _noise(diagnosis)) ** 2)) for one in before]
    number = int(np.argmax(left))
    rows = max(FEWEST_ROWS, MOST_NUMBERS // before[number].seen[0, 0].size)
    shown = [("declared", before[number]), ("with what was found", after[number])][: 2 if diagnosis.findings else 1]
    found = Overlay(
        diagnosis.data[number].source, len(before[number].t), before[number].t[:rows], before[number].seen[:rows, 0],
        noise=_noise(diagnosis), curves={name: one.level[:rows, 0] for name, one in shown},
    )  # fmt: skip
    return found.read_as(diagnosis.data[number].origin)


def _noise(diagnosis: Diagnosis) -> Float[ndarray, " sites"]:
    return np.asarray(diagnosis.noise)[: diagnosis.after.chain.sites]
