"""The effects that were added to an equation and the declared terms, with coefficients, parameters and standard errors.

Sites are counted from 1, frequencies are angular ones (as in cos(omega*t)).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.document import Content, Number
from latticebench.bench.report.units import Units, in_sentence, of_natural, units_of
from latticebench.diagnosis.acting import Placed

if TYPE_CHECKING:
    from collections.abc import Callable

    from latticebench.diagnosis.finding import Finding
    from latticebench.diagnosis.fitting import Fitted
    from latticebench.diagnosis.repair import Diagnosis

# Step of a difference quotient, in standard errors: small against what bends a curve, large against rounding.
STEP = 1e-3


class Size(Content):
    """A number with its standard error and its unit; "" where it has none or none is known."""

    value: Number
    stderr: Number
    unit: str = ""


class AddedEffect(Content):
    """An effect as it was added to the equation.

    Attributes:
        effect: its name.
        said: what it does, one sentence each; nothing where its terms say all.
        parameters: where and how it acts: site (from 1), omega, delay, at, width, s, ends, ...
        coefficients: by the text of the term, or by what the instrument does ("offset of u3").
        stderr: standard errors of coefficients and fitted parameters, as far as they are known.
        natural: its numbers in the form in which people know them: a factor, a mass ratio, a decay time, ...
        evidence: natural logarithm of how much likelier it makes the readings, in the last model.
        indistinguishable: effects that explain these data as well.
    """

    effect: str
    said: tuple[str, ...]
    parameters: dict[str, int | Number | str]
    coefficients: dict[str, Number]
    stderr: dict[str, Number]
    natural: dict[str, Size]
    evidence: Number
    indistinguishable: tuple[str, ...] = ()


def added(diagnosis: Diagnosis) -> tuple[AddedEffect, ...]:
    """Return the effects that were found, in the order in which the diagnosis gives them.

    Natural forms and sentences are in the units of the recording, coefficients in those of the equation.
    """
    chain = diagnosis.after.chain
    units = units_of(diagnosis.data[0].origin)
    frequency = min((one.frequency for one in diagnosis.modes[0]), default=float("nan"))

    def natural(placed: Placed) -> dict[str, float]:
        return placed.natural(chain, frequency)

    found = []
    for one in diagnosis.findings:
        placed, labels = one.placed, one.placed.labels(chain)
        settings, errors = _with_errors(one, Placed.settings), {name: error for name, (_, error) in one.values.items()}
        errors |= {name: size.stderr for name, size in settings.items() if np.isfinite(size.stderr)}
        found.append(
            AddedEffect(
                effect=one.name, said=tuple(in_sentence(line, units) for line in placed.sentences(chain)),
                parameters=placed.settings(),
                coefficients=dict(zip(labels, placed.strength, strict=True)), stderr=errors,
                natural={
                    name: _in_units(name, size, units, chain.order) for name, size in _with_errors(one, natural).items()
                },
                evidence=one.evidence, indistinguishable=one.alternatives,
            )
        )  # fmt: skip
    return tuple(found)


def _in_units(name: str, size: Size, units: Units, order: int) -> Size:
    factor, unit = of_natural(name, units, order)
    return Size(value=size.value * factor, stderr=size.stderr * abs(factor), unit=unit)


def _with_errors(one: Finding, function: Callable[[Placed], Mapping[str, float | int | str]]) -> dict[str, Size]:
    """Return the numbers that a function makes of an effect's numbers, with standard errors to first order.

    Correlations between the numbers of one effect are left out: each of what is said of an effect rests on one of them.
    """
    here, moot = one.placed.numbers, one.placed.moot
    names = (*[""] * len(one.placed.strength), *one.placed.shape)
    errors = np.zeros(len(here))
    errors[[name not in moot for name in names]] = [error for _, error in one.values.values()]
    found = {name: value for name, value in _floats(function(one.placed)).items() if name not in moot}
    slopes = {name: np.zeros(len(here)) for name in found}
    for k, error in enumerate(errors):
        step = STEP * (error if error > 0 and np.isfinite(error) else max(abs(here[k]), STEP))
        moved = _floats(function(one.placed.moved(here + step * np.eye(len(here))[k])))
        moved = {name: value for name, value in moved.items() if name not in moot}
        # Labels contain numbers, such as the time of a pulse: after a step the same entry may have another name.
        there = dict(zip(found, moved.values(), strict=True)) if len(moved) == len(found) else moved
        for name, value in found.items():
            slopes[name][k] = (there[name] - value) / step if name in there else np.nan
    # A number that something does not rest on says nothing of it, even if it is not known itself.
    return {
        name: Size(value=value, stderr=float(np.linalg.norm((slopes[name] * errors)[slopes[name] != 0])) or np.nan)
        for name, value in found.items()
    }


def _floats(numbers: Mapping[str, float | int | str]) -> dict[str, float]:
    return {name: value for name, value in numbers.items() if isinstance(value, float)}


def declared(fitted: Fitted) -> tuple[dict[str, float], dict[str, float]]:
    """Return the declared terms' coefficients and their standard errors, by the text of the term."""
    texts = fitted.model.declared.texts
    return (
        dict(zip(texts, map(float, fitted.model.coefficients), strict=True)),
        dict(zip(texts, map(float, fitted.stderr[: len(texts)]), strict=True)),
    )
