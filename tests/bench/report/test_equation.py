"""Equations in writing: as text, as LaTeX, as MathML."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.mathtext import MathTextParser

from latticebench.bench.report import mathematics
from latticebench.bench.report.equation import Equation, equation
from latticebench.diagnosis.acting import WAYS, Chain, Placed
from latticebench.diagnosis.acting.alternating import Alternating
from latticebench.diagnosis.acting.clock import Clock
from latticebench.diagnosis.acting.clock_jump import ClockJump
from latticebench.diagnosis.acting.cyclic import Cyclic
from latticebench.diagnosis.acting.imbalance import Imbalance
from latticebench.diagnosis.acting.lag import Lag
from latticebench.diagnosis.acting.sensor_clock import SensorClock
from latticebench.diagnosis.acting.side_mass import SideMass
from latticebench.diagnosis.acting.support import SwayingSupport
from latticebench.diagnosis.model import Model
from latticebench.systems.effects import CATALOGUE, Effect, find
from latticebench.systems.lattice import library

SITES = 5
Forms = Callable[[Effect, Chain], list[Placed]]
Chains = Callable[..., Chain]


def shown(declared: str, added: Sequence[Placed], chain: Chain) -> Equation:
    """The equation of a model with coefficients of all sizes."""
    terms = library("own", declared)
    count = len(terms.terms)
    return equation(Model(terms, chain.order, tuple(10.0 ** np.arange(-6, count - 6)), tuple(added)), chain)


def check(found: Equation, added: Sequence[Placed], chain: Chain) -> None:
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
    for one in added:
        assert one.effect.name in named or set(one.sentences(chain)) & set(found.elsewhere)


@pytest.mark.parametrize(
    ("order", "is_complex", "declared"),
    [(2, False, "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), (1, True, "i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]")],
)
def test_every_effect_alone_and_any_two_of_unlike_kinds_can_be_written_in_every_form(
    order: int, is_complex: bool, declared: str, forms: Forms, chain_of: Chains
) -> None:
    chain = chain_of(SITES, order, is_complex=is_complex, levels=order)
    every = [placed for effect in CATALOGUE for placed in forms(effect, chain)]
    assert len({placed.effect.name for placed in every}) > 20
    never = (
        {Clock, ClockJump, Cyclic, Lag, SensorClock, SideMass, SwayingSupport}
        if order == 1
        else {Alternating, Imbalance}
    )
    assert {type(placed) for placed in every} >= set(WAYS.values()) - never
    reader = MathTextParser("path")
    for one in every:
        found = shown(declared, [one], chain)
        check(found, [one], chain)
        reader.parse(f"${found.latex}$")
    kinds = {(type(one), len(one.numbers), one.site is None): one for one in every}
    for pair in itertools.combinations(kinds.values(), 2):
        check(shown(declared, pair, chain), pair, chain)


def test_a_term_at_one_site_stands_beside_the_equation_and_not_in_it(forms: Forms, chain_of: Chains) -> None:
    chain = chain_of(SITES)
    pair = [*forms(find("next-neighbour"), chain), *forms(find("defect"), chain)]
    found = shown("u[n+1]+u[n-1]-2*u[n]; u[n]", pair, chain)
    assert [one.effect for one in found.terms] == [None, None, "next-neighbour"]
    lines = found.elsewhere
    assert [line.rsplit("*", 1)[1] for line in lines] == ["u[n] besides", "sin(u[n]) besides"]
    assert all(line.startswith("site 1 alone has ") for line in lines)


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
def test_the_left_hand_side_has_dots(order: int, dots: str, chain_of: Chains) -> None:
    found = shown("u[n]", [], chain_of(SITES, order))
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
