"""Which measurement would tell two effects apart that explain a recording equally well."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.document import Content
from latticebench.diagnosis.acting import way_of
from latticebench.systems.effects import CATALOGUE, Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis

# What may help where nothing is known of how two effects differ.
MORE = "a longer recording, less noise, or another initial state"


class Separation(Content):
    """An added effect, one that explains the recording as well, and what would separate them."""

    effect: str
    other: str
    measurement: str


def separations(diagnosis: Diagnosis) -> tuple[Separation, ...]:
    """Return each added effect with each one that cannot be told from it."""
    chain = diagnosis.after.chain
    known = {one.name: one for one in (*CATALOGUE, *(found.placed.effect for found in diagnosis.findings))}
    found = []
    for one in diagnosis.findings:
        for name in one.alternatives:
            other = known.get(name)
            said = MORE if other is None else separation(one.placed.effect, other, chain.order, chain.is_complex)
            found.append(Separation(effect=one.name, other=name, measurement=said))
    return tuple(found)


def separation(one: Effect, other: Effect, order: int, is_complex: bool) -> str:
    """Return which measurement would tell two effects apart, from how they act and how their terms grow."""
    return way_of(one).separated_from(way_of(other)) or _by_growth(one, other, order, is_complex)


def _by_growth(one: Effect, other: Effect, order: int, is_complex: bool) -> str:
    """Return what separates two terms that see different things, or grow with different powers of the field."""
    first, second = (_traits(effect, order, is_complex) for effect in (one, other))
    if first.power is not None and second.power is not None and first.power != second.power:
        (low, lower), (high, higher) = sorted(((first.power, one.name), (second.power, other.name)))
        return f"swings of another size: {lower} grows {_power(low)}, {higher} {_power(high)}"
    if first.place != second.place:
        return "a motion near the middle of the chain, and one far from it"
    if first.velocity != second.velocity:
        return "swings of the same size at another frequency: what acts on the velocity grows with it"
    if first.input != second.input:
        return "a recording without the input, or with another one"
    if first.reach != second.reach:
        return "waves of other lengths: what couples neighbours depends on it"
    return MORE


@dataclass(frozen=True)
class _Traits:
    """How a term grows: with which power of the field (None: with no single one), and what it sees."""

    power: float | None
    velocity: bool
    place: bool
    input: bool
    reach: int


@cache
def _traits(effect: Effect, order: int, is_complex: bool) -> _Traits:
    from latticebench.systems.stencil import evaluate

    texts = effect.texts(order, is_complex) or (effect.formula or effect.complex_field or "1",)
    term = Term(texts[0])
    draw = np.random.default_rng(1)
    u, v = draw.normal(size=(2, 3, 24)) + (1j * draw.normal(size=(2, 3, 24)) if is_complex else 0)
    f, t = draw.normal(size=(3, 24)), np.arange(3.0)
    with np.errstate(all="ignore"):
        small, large = (evaluate([term], k * u, k * v, k * f, t, ends="periodic") for k in (1.0, 2.0))
        ratio = np.log2(np.abs(large / small))
    ratio = ratio[np.isfinite(ratio)]
    power = round(float(np.mean(ratio)), 3) if len(ratio) and np.ptp(ratio) < 1e-6 else None
    fields = {name for name, _ in term.sites}
    return _Traits(power, "v" in fields, "n" in term.names, "f" in fields, max(term.reach))


def _power(power: float) -> str:
    named = {0.0: "not at all with the size", 1.0: "as the size", 2.0: "as its square", 3.0: "as its cube"}
    return named.get(power, f"as its power {power:g}")
