"""The equation of a fitted model: the terms that act at every site, and in words what acts elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.document import Content, Number
from latticebench.bench.report.findings import blocks, labels, reading
from latticebench.bench.report.mathematics import (
    DIGITS,
    expression,
    latex,
    latex_summand,
    mathml,
    mathml_summand,
    text_of_sum,
)
from latticebench.diagnosis.model import Fitted
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.systems.effects import INSTRUMENT

if TYPE_CHECKING:
    import sympy

# So many coefficients of one effect are listed one by one.
LISTED = 8


class Summand(Content):
    """One term of the right-hand side.

    Attributes:
        effect: the effect that brought it in; None for a declared term.
        text: the term as text.
        coefficient: what it is multiplied by.
        latex, mathml: coefficient and term with their sign; empty where the coefficient is 0.
    """

    effect: str | None
    text: str
    coefficient: Number
    latex: str
    mathml: str


class Equation(Content):
    """An equation with numbers in it.

    Attributes:
        text: left-hand side and the terms that act at every site, on one line.
        latex: the same in LaTeX.
        left: the left-hand side and the sign of equality in MathML.
        terms: the terms that act at every site.
        elsewhere: what acts at single sites, at the ends and on the readings, one sentence each.
    """

    text: str
    latex: str
    left: str
    terms: tuple[Summand, ...]
    elsewhere: tuple[str, ...]


def equation(fitted: Fitted) -> Equation:
    """Return the equation of a fitted model in all its forms."""
    import sympy

    terms: list[Summand] = []
    for effect, text, value, body in _everywhere(fitted):
        first = not any(one.latex for one in terms)
        shown = (
            (latex_summand(value, body, first=first), mathml_summand(value, body, first=first)) if value else ("", "")
        )
        terms.append(Summand(effect=effect, text=text, coefficient=value, latex=shown[0], mathml=shown[1]))
    order = fitted.model.order
    left = sympy.Symbol(rf"\{'d' * order}ot{{u}}_{{n}}")
    right = " ".join(one.latex for one in terms if one.latex) or "0"
    sum_ = text_of_sum([one.text for one in terms], [one.coefficient for one in terms])
    return Equation(
        text=f"u{chr(39) * order} = {sum_}", latex=f"{latex(left)} = {right}",
        left=f"<mrow>{mathml(left)}<mo>=</mo></mrow>", terms=tuple(terms), elsewhere=tuple(_elsewhere(fitted)),
    )  # fmt: skip


def _everywhere(fitted: Fitted) -> list[tuple[str | None, str, float, sympy.Expr]]:
    """Return the terms that act at every site: effect, text, coefficient and what it is multiplied with."""
    values = [float(value) for value in fitted.solution.state.coefficients]
    texts = fitted.model.declared.texts
    found: list[tuple[str | None, str, float, sympy.Expr]] = [
        (None, text, value, expression(text)) for text, value in zip(texts, values[: len(texts)], strict=True)
    ]
    for change, block in zip(fitted.model.effects, blocks(fitted), strict=True):
        if change.effect.acts in ("one site", "every site") or change.as_force:
            continue
        named = [_text(change, label) for label in labels(change, fitted)]
        pieces = zip(named, values[block], bodies(change) if named else [], strict=True)
        found += [(change.effect.name, text, value, body) for text, value, body in pieces]
    return found


def _text(change: PlacedEffect, label: str) -> str:
    """Return a label so that it can stand in a product."""
    lead = "i*" if label.startswith("i*") else ""
    if change.effect.acts == "delayed":
        return f"{lead}u[n](t-{change.psi['delay']:.4g})"
    if change.effect.acts == "long range":
        return f"{lead}sum((u[n+r]+u[n-r]-2*u[n])/r**{change.psi['s']:.3g}, r>=2)"
    return label


def bodies(change: PlacedEffect) -> list[sympy.Expr]:
    """Return what each coefficient of an effect that acts at every site is multiplied with."""
    import sympy

    acts, psi = change.effect.acts, change.psi
    t = sympy.Symbol("t", real=True)
    terms = [expression(text) for text in change.texts]
    if acts == "harmonic":
        phase = sympy.Float(psi["omega"], 6) * t
        return [wave(phase) * term for term in terms for wave in (sympy.cos, sympy.sin)]
    if acts == "pulse":
        return [_pulse(t, psi["at"], psi["width"]) * term for term in terms]
    if acts == "alternating":
        return [sympy.Integer(-1) ** sympy.Symbol("n", integer=True) * term for term in terms]
    if acts == "delayed":
        past = sympy.Function("u_{n}")(t - sympy.Float(psi["delay"], DIGITS))
        return [past, sympy.I * past][: len(terms)]
    if acts == "long range":
        r = sympy.Symbol("r", integer=True)
        far = sympy.Symbol("u_{n+r}") + sympy.Symbol("u_{n-r}") - 2 * sympy.Symbol("u_{n}")
        total = sympy.Sum(far / r ** sympy.Float(psi["s"], 3), (r, 2, sympy.oo))
        return [total, sympy.I * total][: len(terms)]
    return terms


def _pulse(t: sympy.Symbol, at: float, width: float) -> sympy.Expr:
    """Return exp(-(t - at)^2 / (2 width^2)), with the numbers where a reader looks for them."""
    import sympy

    square = (t - sympy.Float(at, DIGITS)) ** 2
    below = sympy.Mul(2, sympy.Pow(sympy.Float(width, DIGITS), 2, evaluate=False), evaluate=False)
    exponent = sympy.Mul(-1, square, sympy.Pow(below, -1, evaluate=False), evaluate=False)
    return sympy.exp(sympy.UnevaluatedExpr(exponent))


def _elsewhere(fitted: Fitted) -> list[str]:
    """Return what acts at single sites, at the ends and on the readings, one sentence each."""
    found = []
    for change, block in zip(fitted.model.effects, blocks(fitted), strict=True):
        values = [float(value) for value in fitted.solution.state.coefficients[block]]
        if change.effect.acts in INSTRUMENT:
            found += _misread(change, values, fitted.data[0].is_complex)
        elif change.effect.acts == "ends":
            found.append(f"the ends are {change.ends}")
        else:
            found += _local(change, values)
    return found


def _local(change: PlacedEffect, values: list[float]) -> list[str]:
    """Return what an effect does that acts at one site, or differently at each."""
    acts = change.effect.acts
    if acts == "one site" and change.site is not None:
        return [f"site {change.site + 1} alone has {text_of_sum(change.texts, values)} besides"]
    if acts == "one equation" and change.site is not None:
        factor = 1 + change.psi["scale"]
        return [
            f"site {change.site + 1}: its whole right-hand side is multiplied by {factor:.{DIGITS}g} "
            f"(a mass of {1 / factor:.{DIGITS}g} times the others')"
        ]
    if acts == "every site":
        each = np.reshape(values, (len(change.texts), -1))
        named = " and ".join(change.texts)
        if change.psi.get("whole"):
            about = f"mean {np.mean(each):.3g}, standard deviation {np.std(each):.3g}"
        else:
            each = np.concatenate([each, -np.sum(each, axis=1, keepdims=True)], axis=1)
            about = (
                f"deviations from their mean, which belongs to {named} itself; standard deviation {np.std(each):.3g}"
            )
        return [f"every site has {named} besides, with a coefficient of its own: {about}"]
    return []


def _misread(change: PlacedEffect, values: list[float], is_complex: bool) -> list[str]:
    """Return what the instrument makes of the readings."""
    acts, psi = change.effect.acts, change.psi
    if change.as_force and len(values) <= LISTED:
        return [f"site {number} alone has {value:.{DIGITS}g} besides" for number, value in enumerate(values, start=1)]
    if change.as_force:
        return [f"every site has a constant force of its own: {_rms(values):.{DIGITS}g} (RMS)"]
    if acts == "rounding":
        return [f"readings are rounded to multiples of {psi['step']:.{DIGITS}g}"]
    if len(change.free) <= LISTED:
        return [f"{reading(change, name, is_complex)}: {psi[name]:.{DIGITS}g}" for name in change.free]
    size = _rms([psi[name] for name in change.free])
    return [f"{acts} of every {'row' if acts == 'clock' else 'site'}: {size:.{DIGITS}g} (RMS)"]


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
