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
    for placed, block in zip(fitted.model.effects, blocks(fitted), strict=True):
        if placed.effect.acts in ("one site", "every site") or placed.as_force:
            continue
        named = [_text(placed, label) for label in labels(placed, fitted)]
        pieces = zip(named, values[block], bodies(placed) if named else [], strict=True)
        found += [(placed.effect.name, text, value, body) for text, value, body in pieces]
    return found


def _text(placed: PlacedEffect, label: str) -> str:
    """Return a label so that it can stand in a product."""
    lead = "i*" if label.startswith("i*") else ""
    if placed.effect.acts == "delayed":
        return f"{lead}u[n](t-{placed.psi['delay']:.4g})"
    if placed.effect.acts == "long range":
        return f"{lead}sum((u[n+r]+u[n-r]-2*u[n])/r**{placed.psi['s']:.3g}, r>=2)"
    return label


def bodies(placed: PlacedEffect) -> list[sympy.Expr]:
    """Return what each coefficient of an effect that acts at every site is multiplied with."""
    import sympy

    acts, psi = placed.effect.acts, placed.psi
    t = sympy.Symbol("t", real=True)
    terms = [expression(text) for text in placed.texts]
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
    for placed, block in zip(fitted.model.effects, blocks(fitted), strict=True):
        values = [float(value) for value in fitted.solution.state.coefficients[block]]
        if placed.effect.acts in INSTRUMENT:
            found += _misread(placed, values, fitted.data[0].is_complex)
        elif placed.effect.acts == "ends":
            found.append(f"the ends are {placed.ends}")
        else:
            found += _local(placed, values)
    return found


def _local(placed: PlacedEffect, values: list[float]) -> list[str]:
    """Return what an effect does that acts at one site, or differently at each."""
    acts = placed.effect.acts
    if acts == "one site" and placed.site is not None:
        return [f"site {placed.site + 1} alone has {text_of_sum(placed.texts, values)} besides"]
    if acts == "one equation" and placed.site is not None:
        factor = 1 + placed.psi["scale"]
        return [
            f"site {placed.site + 1}: its whole right-hand side is multiplied by {factor:.{DIGITS}g} "
            f"(a mass of {1 / factor:.{DIGITS}g} times the others')"
        ]
    if acts == "every site":
        each = np.reshape(values, (len(placed.texts), -1))
        named = " and ".join(placed.texts)
        if placed.psi.get("whole"):
            about = f"mean {np.mean(each):.3g}, standard deviation {np.std(each):.3g}"
        else:
            each = np.concatenate([each, -np.sum(each, axis=1, keepdims=True)], axis=1)
            about = (
                f"deviations from their mean, which belongs to {named} itself; standard deviation {np.std(each):.3g}"
            )
        return [f"every site has {named} besides, with a coefficient of its own: {about}"]
    return []


def _misread(placed: PlacedEffect, values: list[float], is_complex: bool) -> list[str]:
    """Return what the instrument makes of the readings."""
    acts, psi = placed.effect.acts, placed.psi
    if placed.as_force and len(values) <= LISTED:
        return [f"site {number} alone has {value:.{DIGITS}g} besides" for number, value in enumerate(values, start=1)]
    if placed.as_force:
        return [f"every site has a constant force of its own: {_rms(values):.{DIGITS}g} (RMS)"]
    if acts == "rounding":
        return [f"readings are rounded to multiples of {psi['step']:.{DIGITS}g}"]
    if len(placed.free) <= LISTED:
        return [f"{reading(placed, name, is_complex)}: {psi[name]:.{DIGITS}g}" for name in placed.free]
    size = _rms([psi[name] for name in placed.free])
    return [f"{acts} of every {'row' if acts == 'clock' else 'site'}: {size:.{DIGITS}g} (RMS)"]


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
