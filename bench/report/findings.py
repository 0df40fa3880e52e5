"""The effects that were added to an equation and the declared terms, with coefficients, parameters and standard errors.

Sites are counted from 1, frequencies are angular ones (as in cos(omega*t)).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.document import Content, Number
from latticebench.diagnosis.model import Fitted
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.systems.effects import INSTRUMENT

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis


class AddedEffect(Content):
    """An effect as it was added to the equation.

    Attributes:
        effect: its name.
        parameters: where and how it acts: site (from 1), omega, delay, at, width, s, ends, ...
        coefficients: by the text of the term, or by what the instrument does ("offset of u3").
        stderr: standard errors of coefficients and fitted parameters, as far as they are known.
        indistinguishable: effects that explain these data as well.
    """

    effect: str
    parameters: dict[str, bool | int | Number | str]
    coefficients: dict[str, Number]
    stderr: dict[str, Number]
    indistinguishable: tuple[str, ...] = ()


def added(diagnosis: Diagnosis) -> tuple[AddedEffect, ...]:
    """Return the effects of the last model, in the order in which they were added."""
    course = diagnosis.course
    fitted = course.after
    errors = np.sqrt(np.maximum(np.diag(fitted.solution.covariance), 0.0))
    found = []
    pieces = zip(fitted.model.effects, blocks(fitted), course.equal, strict=True)
    for number, (placed, block, equal) in enumerate(pieces):
        names = labels(placed, fitted)
        coefficients = dict(zip(names, map(float, fitted.solution.state.coefficients[block]), strict=True))
        stderr = dict(zip(names, map(float, errors[block]), strict=True))
        known = fitted.psi_errors[number] if number < len(fitted.psi_errors) else {}
        parameters: dict[str, bool | int | float | str] = {} if placed.site is None else {"site": placed.site + 1}
        if placed.ends:
            parameters["ends"] = placed.ends
        for name, value in placed.psi.items():
            if name in ("inner", "origin"):
                # Of use to the fit alone.
                continue
            if placed.effect.acts in INSTRUMENT and name in placed.free:
                label = reading(placed, name, fitted.data[0].is_complex)
                coefficients[label] = float(value)
            else:
                label = name
                parameters[name] = bool(value) if name == "open" else int(value) if name == "reach" else float(value)
            if name in known:
                stderr[label] = float(known[name])
        if placed.effect.acts == "one equation":
            # The force is what it was; the site answers it as a mass of this size would.
            ratio = 1 / (1 + float(placed.psi["scale"]))
            parameters["mass_ratio"] = ratio
            if "scale" in stderr:
                stderr["mass_ratio"] = stderr["scale"] * ratio**2
        found.append(
            AddedEffect(
                effect=placed.effect.name, parameters=parameters, coefficients=coefficients, stderr=stderr,
                indistinguishable=equal,
            )
        )  # fmt: skip
    return tuple(found)


def declared(fitted: Fitted) -> tuple[dict[str, float], dict[str, float]]:
    """Return the declared terms' coefficients and their standard errors, by the text of the term."""
    texts = fitted.model.declared.texts
    values = fitted.solution.state.coefficients[: len(texts)]
    errors = np.sqrt(np.maximum(np.diag(fitted.solution.covariance)[: len(texts)], 0.0))
    return (
        {text: float(value) for text, value in zip(texts, values, strict=True)},
        {text: float(error) for text, error in zip(texts, errors, strict=True)},
    )


def blocks(fitted: Fitted) -> list[slice]:
    """Return which coefficients of a fit are those of each added effect."""
    samples = fitted.data[0]
    begin, found = len(fitted.model.declared.terms), []
    for placed in fitted.model.effects:
        end = begin + len(placed.forces(samples.sites, samples.is_complex))
        found.append(slice(begin, end))
        begin = end
    return found


def labels(placed: PlacedEffect, fitted: Fitted) -> list[str]:
    """Return a text for each coefficient of an added effect."""
    samples = fitted.data[0]
    found = [force.label for force in placed.forces(samples.sites, samples.is_complex)]
    # A force that is i times 1.
    return [label.removesuffix("*1") if label.endswith("i*1") else label for label in found]


def reading(placed: PlacedEffect, name: str, is_complex: bool) -> str:
    """Return what a parameter of the instrument is, with the names of the file's columns."""
    kind, _, number = name.partition("_")
    if placed.effect.acts == "clock":
        return f"lateness of row {number}" if kind == "row" else "slowness of the clock"
    if is_complex and placed.effect.acts == "offset":
        column = f"{'im' if kind == 'imaginary' else 're'}{number}"
    elif is_complex:
        column = f"re{number} and im{number}"
    else:
        column = f"u{number}" + (f" and v{number}" if placed.both else "")
    return f"{placed.effect.acts} of {column}"
