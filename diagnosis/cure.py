"""A diagnosis put to use: what was found as terms of a library, and recordings without what their instruments add.

A term at one site alone is a term times 1 - sign(n - m)^2, which is 1 where n = m and 0 elsewhere; n is the number of
the site, counted from the middle of the chain, as the term language has it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.late import MOST_TURNED, Late
from latticebench.diagnosis.reading import Sensitivity, read_by
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.stencil import numbers
from latticebench.systems.terms import combination

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.acting import Chain, Placed
    from latticebench.diagnosis.model import Model
    from latticebench.systems.samples import Samples
    from latticebench.systems.stencil import Ends

# Newton's steps to the field whose reading is known; instruments are nearly linear.
STEPS = 20
# A text that needs no brackets in a product.
SIMPLE = re.compile(r"|[uvf]\[n(?:[+-]\d+)?\](?:\*\*\d+)?")
# Digits of a weight or a number of time within a term.
DIGITS = 12


@dataclass(frozen=True)
class Cure:
    """What was found, as an equation with free coefficients.

    Attributes:
        terms: the declared ones and, after them, those that were found, each where and when it acts.
        ends: how the chain ends.
        left_out: the effects that no term can say: memory, a clock, what is not read.
    """

    terms: tuple[str, ...]
    ends: Ends
    left_out: tuple[str, ...]


def cure(model: Model, chain: Chain) -> Cure:
    """Return a fitted model as an equation with free coefficients."""
    terms, left_out, ends = list(model.declared.texts), [], chain.ends
    for placed in model.effects:
        ends = placed.other_ends() or ends
        found = _terms(placed, model, chain)
        if found is None:
            left_out.append(placed.effect.name)
        terms += found or []
    return Cure(tuple(dict.fromkeys(terms)), ends, tuple(left_out))


def _terms(placed: Placed, model: Model, chain: Chain) -> list[str] | None:
    """Return an effect as terms, one for each strength; None where no term can say it."""
    if placed.quickened() is not None:
        return None
    if placed.instrument or placed.other_ends():
        return []
    site = placed.scaled()
    if site is not None:
        whole = combination(model.declared.terms, model.coefficients).text
        return [f"{_where(np.eye(chain.sites)[site])}*({whole})"]
    forces = placed.forces(chain)
    if not forces or placed.fed or placed.resonator(chain) is not None:
        return None
    sums: list[list[str]] = [[] for _ in placed.strength]
    for force in forces:
        for number, share in force.by.items():
            # Later numbers are a frequency, a time, ...: they stay as they were found.
            if number < len(sums):
                factors = [f"{share:.{DIGITS}g}" if share != 1 else "", _where(force.weights), _when(force.factor)]
                text = "" if force.text == "1" and any(factors) else force.text
                parts = [*filter(None, factors), text if SIMPLE.fullmatch(text) or not any(factors) else f"({text})"]
                sums[number].append("*".join(filter(None, parts)))
    return [one[0] if len(one) == 1 else " + ".join(one) for one in sums if one]


def _where(weights: Float[ndarray, " sites"] | None) -> str:
    """Return weights of the sites as a function of the site number; nothing where all are 1."""
    if weights is None or np.all(weights == 1):
        return ""
    if np.array_equal(weights, np.where(np.arange(len(weights)) % 2 == 0, 1.0, -1.0)):
        return f"cos(pi*(n{-numbers(len(weights))[0]:+g}))"
    parts = [
        (f"{weight:.{DIGITS}g}*" if weight != 1 else "") + f"(1-sign(n{-place:+g})**2)"
        for place, weight in zip(numbers(len(weights)).tolist(), weights.tolist(), strict=True)
        if weight
    ]
    return parts[0] if len(parts) == 1 else f"({' + '.join(parts)})"


def _when(factor: object) -> str:
    """Return a factor of time as text; nothing for 1."""
    return "" if factor is None else str(factor)


def corrected(model: Model, samples: Samples, recording: int) -> Samples:
    """Return a recording as instruments without the model's faults would have read it; what is missing stays so.

    What `staying` returns stays. Where a clock jumps, times are corrected. What a sensor hears of one that was not read
    for a while is taken from straight lines.

    Args:
        model: whose instruments are undone.
        samples: the recording.
        recording: its number among those that the model was fitted to.
    """
    both = samples.v is not None and model.order == 2
    every = [placed for placed, _ in model.instruments(recording) if placed.quickened() is None]
    remains = staying(every, velocities=both)
    lost = sum((placed.told(samples.t) - samples.t for placed in every), np.zeros(len(samples.t)))
    t = samples.t + lost if np.all(np.diff(samples.t + lost) > 0) else samples.t
    faults = [one for one in every if one not in remains and np.array_equal(one.told(samples.t), samples.t)]
    if not faults:
        return replace(samples, t=t)
    fields = [samples.u, samples.v] if both and samples.v is not None else [samples.u]
    read = np.stack([split_parts(one, samples.is_complex) for one in fields], axis=1)
    known = np.isfinite(read)
    whole = _bridged(samples.t, read)
    field = whole.copy()
    for _ in range(STEPS):
        wrong = read_by(faults, samples.t, field)
        field -= Sensitivity.of(wrong).undone(field + wrong.added - whole)
    field = np.where(known, field, np.nan)
    parts = field[:, :, 0] + (1j * field[:, :, 1] if samples.is_complex else 0.0)
    return replace(samples, t=t, u=parts[:, 0], v=parts[:, 1] if both else samples.v)


def staying(instruments: Sequence[Placed], *, velocities: bool) -> list[Placed]:
    """Return those of the instruments whose faults corrected readings still have.

    These are zeros that wander, which are no numbers; what makes readings late where no velocities were read; and all
    of it where together it turns a swing by more than a sixth of a period.

    Args:
        instruments: of a model.
        velocities: whether those were read.
    """
    late = [one for one in instruments if isinstance(one, Late)]
    far = sum(one.omega * one.latest for one in late) > MOST_TURNED
    return [one for one in instruments if one.stays(velocities=velocities) or (far and one in late and one.latest > 0)]


def _bridged(t: ndarray, read: Float[ndarray, "time levels parts sites"]) -> ndarray:
    """Return readings with straight lines where none were taken, and nothing where there are none at all."""
    found = read.copy()
    for channel in np.moveaxis(found.reshape(len(t), -1), 1, 0):
        known = np.isfinite(channel)
        if not np.all(known):
            channel[~known] = np.interp(t[~known], t[known], channel[known]) if np.any(known) else 0.0
    return found
