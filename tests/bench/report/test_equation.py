"""Equations in writing: as text, as LaTeX, as MathML."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.mathtext import MathTextParser

from latticebench.bench.report import mathematics
from latticebench.bench.report.equation import Equation, equation
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.systems.effects import CATALOGUE, Effect, find
from latticebench.systems.lattice import library

SITES = 5
PSI: dict[str, dict[str, float]] = {
    "harmonic": {"omega": 1.7234567}, "pulse": {"at": 3.25, "width": 0.3}, "delayed": {"delay": 0.51},
    "long range": {"s": 2.5, "reach": 4.0, "open": 1.0}, "one equation": {"scale": 0.25}, "curve": {"all_1": 0.02},
    "rounding": {"step": 0.01, "inner": 0.0, "origin": 0.0}, "clock": {"rate": 1e-3}, "gain": {"real_3": 0.1},
}  # fmt: skip


def changes(effect: Effect, order: int, is_complex: bool) -> list[PlacedEffect]:
    """The effect as it is put into a model; a sensor's offset also as what it does to the equation."""
    texts = effect.texts(order, is_complex)
    if not texts:
        return []
    psi = PSI.get(effect.acts, {})
    site = 2 if effect.acts in ("one site", "one equation", "gain") else None
    past = (lambda t: np.zeros((len(t), 2 if is_complex else 1, SITES)),)
    ends = "fixed" if effect.acts == "ends" else None
    change = PlacedEffect(effect, texts, psi, site, ends, past)
    if effect.acts != "offset":
        return [change]
    each = {f"real_{k + 1}": 0.1 * k for k in range(SITES)}
    return [PlacedEffect(effect, texts, {"real_3": 0.1}, 2), PlacedEffect(effect, texts, each, as_force=True)]


def shown(declared: str, added: list[PlacedEffect], order: int, is_complex: bool) -> Equation:
    """The equation of a model with coefficients of all sizes."""
    model = Model(library("own", declared), order, tuple(added))
    data = [SimpleNamespace(sites=SITES, is_complex=is_complex)]
    count = len(model.declared.terms) + sum(len(one.forces(SITES, is_complex)) for one in added)
    values = np.random.default_rng(1).normal(size=count) * 10.0 ** np.arange(-6, count - 6)
    fitted: Any = SimpleNamespace(
        model=model, data=data, solution=SimpleNamespace(state=SimpleNamespace(coefficients=values))
    )
    return equation(fitted)


def check(found: Equation, added: list[PlacedEffect]) -> None:
    """Every form is whole: brackets close, the MathML is sound, and each effect is somewhere."""
    assert found.latex.count("{") == found.latex.count("}")
    assert found.latex.count(r"\left") == found.latex.count(r"\right")
    for letter in ("at site", "nan", "zoo", "**", "u_{n"):
        assert (letter in found.latex) == (letter == "u_{n")
    for part in (found.left, *(one.mathml for one in found.terms)):
        ElementTree.fromstring(part.replace("&InvisibleTimes;", ""))
    assert found.text.startswith("u'")
    assert " at site" not in found.text
    named = {one.effect for one in found.terms}
    local = [change for change in added if change.effect.name not in named]
    assert len(found.elsewhere) >= len(local)


@pytest.mark.parametrize(
    ("order", "is_complex", "declared"),
    [(2, False, "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), (1, True, "i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]")],
)
def test_every_effect_alone_and_all_pairs_can_be_written_in_every_form(
    order: int, is_complex: bool, declared: str
) -> None:
    every = [change for effect in CATALOGUE for change in changes(effect, order, is_complex)]
    assert len(every) > 20
    assert {change.effect.acts for change in every} >= {"harmonic", "pulse", "delayed", "long range", "offset"}
    reader = MathTextParser("path")
    for change in every:
        found = shown(declared, [change], order, is_complex)
        check(found, [change])
        reader.parse(f"${found.latex}$")
    for pair in itertools.combinations(every, 2):
        check(shown(declared, list(pair), order, is_complex), list(pair))


def test_a_force_at_each_site_stands_beside_the_equation_and_not_in_it() -> None:
    offset = next(change for change in changes(find("sensor-offset"), 2, False) if change.as_force)
    pair = [*changes(find("next-neighbour"), 2, False), offset]
    found = shown("u[n+1]+u[n-1]-2*u[n]; u[n]", pair, 2, False)
    assert [one.effect for one in found.terms] == [None, None, "next-neighbour"]
    assert found.elsewhere[0].startswith("site 1 alone has ")
    assert len(found.elsewhere) == SITES


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("u[n+1]+u[n-1]-2*u[n]", "0.5*(u[n+1]+u[n-1]-2*u[n])"),
        ("(u[n+1]-u[n-1])/2", "0.5*(u[n+1]-u[n-1])/2"),
        ("u[n]**-2", "0.5*u[n]**-2"),
        ("-u[n]", "0.5*(-u[n])"),
        ("cos(1e-05*t)*u[n]", "0.5*cos(1e-05*t)*u[n]"),
        ("1e-05*u[n]", "0.5*1e-05*u[n]"),
        ("re(u[n])+im(u[n])", "0.5*(re(u[n])+im(u[n]))"),
        ("1", "0.5"),
        ("u[n](t-0.51)", "0.5*u[n](t-0.51)"),
    ],
)
def test_a_sum_behind_a_factor_has_brackets(text: str, written: str) -> None:
    assert mathematics.text_of_sum([text], [0.5]) == written


def test_a_sum_without_coefficients_is_zero() -> None:
    assert mathematics.text_of_sum(["u[n]", "u[n]**2"], [0.0, 0.0]) == "0"


def test_a_term_is_written_with_its_indices_and_without_what_browsers_lack() -> None:
    text = mathematics.mathml(mathematics.expression("u[n+1]+u[n-1]-2*u[n]"))
    assert text.count("<msub>") == 3
    assert "<mo>+</mo><mn>1</mn>" in text
    assert "menclose" not in mathematics.mathml(mathematics.expression("conj(u[n])**2"))
    wave = mathematics.mathml(mathematics.expression("cos(1.7*t)*u[n]"))
    assert "<mfrac>" not in wave
    assert "1.7" in wave


@pytest.mark.parametrize(("order", "dots"), [(1, "˙"), (2, "¨")])
def test_the_left_hand_side_has_dots(order: int, dots: str) -> None:
    found = shown("u[n]", [], order, False)
    assert f">{dots}</mo>" in found.left
    assert found.latex.startswith(rf"\{'d' * order}ot{{u}}_{{n}} = ")


@pytest.mark.parametrize(
    ("value", "latex"), [(0.5, "0.5"), (2.00004, "2"), (1.2e-7, r"1.2 \cdot 10^{-7}"), (-3.14159, "3.142")]
)
def test_numbers_have_four_digits_and_powers_of_ten_where_needed(value: float, latex: str) -> None:
    body = mathematics.expression("u[n]")
    sign = "- " if value < 0 else "+ "
    assert mathematics.latex_summand(value, body) == f"{sign}{latex} u_{{n}}"
    assert ("<msup>" in mathematics.mathml_summand(value, body)) == ("10" in latex)


def test_two_numbers_side_by_side_are_kept_apart() -> None:
    body = mathematics.expression("2*u[n]")
    assert mathematics.latex_summand(0.5, body, first=True) == r"0.5 \cdot 2 u_{n}"
    assert "<mo>·</mo>" in mathematics.mathml_summand(0.5, body)
