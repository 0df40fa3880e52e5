"""Recordings as laboratories have them: a chain, effects that its declared equation lacks, and an instrument.

The size z of an effect is Wald's: the length of the vector of its parameters in units of its Cramer-Rao covariance,
everything else being unknown (declared coefficients, initial state, the other effects). For one parameter this is its
value over its standard error. It is computed at the motion with all effects in it and for the noise that the readings
have. Where the ends are unknown, what the outer sites did is unknown, too; of chains longer than `sight.SHORT` they are
taken as read without noise, so that z is a little too large.

Motions are solved by SciPy's DOP853 to a relative tolerance of 1e-10. Dry friction has a thin layer, see
`chains.LAYER`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.laboratory.chains import Chain, draw_chain
from latticebench.bench.trials.laboratory.effects import (
    ASKED,
    MOST_EFFECTS,
    OFFSET,
    OFTEN,
    Ingredient,
    candidates,
    draw_ingredient,
    is_held_out,
    sensible,
)
from latticebench.bench.trials.laboratory.instruments import KINDS, Kind, draw_instrument
from latticebench.bench.trials.laboratory.sight import FINE, ROUGH, Experiment, Sight
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

SMALLEST, LARGEST = 5.0, 500.0
# The share of each effect that nothing else in the recording can do is at least this.
APART = 0.01
# Two effects are alike where one leaves less than this of the other, in units of the noise: 3 in natural logarithms.
ALIKE = 2.45
ATTEMPTS, SIZINGS, CLOSE = 60, 4, 0.2
# With unknown ends, a chain of so many sites has two at either end that are only read, as far as any effect reaches.
LONG = 9
# Effects that are looked at beyond those that are wanted, as some cannot be told apart.
SPARE = 3


@dataclass(frozen=True)
class LabEffect:
    """What is really in a recording.

    Attributes:
        name: of the catalogue.
        site: where it acts (0, ..., N-1), or None.
        parameters: true values by name, see `bench.trials.laboratory.effects`.
        z: its size over the smallest standard error that it could be known with.
        apart: the share of what it does that nothing else in the recording can do.
        alike: effects each of which would do the same in its place, as far as these readings tell.
        sites: where it would do the same if it acts at one site; its own among them.
        beside: offsets that a diagnosis should find if it takes the zeros of outer sites without an equation as right:
            those of the inner sensors less the displacement at rest that those of the outer ones look like. Empty where
            there are none such, or forces or sensors are not linear.
    """

    name: str
    site: int | None
    parameters: Mapping[str, float]
    z: float
    apart: float
    alike: tuple[str, ...] = ()
    sites: tuple[int, ...] = ()
    beside: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LabRecording:
    """A recording and what is in it.

    Attributes:
        samples: positions with noise; ends known or "unknown".
        declared: the declared equation.
        order: of the time derivative.
        effects: what the declared equation lacks.
        coefficients: true ones of the declared terms.
        clean: readings without noise, but with all that the instrument does by rule (T, N).
        noise: RMS of the noise that was added at each sensor (N,).
        instrument: its kind.
        chain: what moved.
        seed: of the recording.
    """

    samples: Samples
    declared: Library
    order: int
    effects: tuple[LabEffect, ...]
    coefficients: Float[ndarray, " terms"]
    clean: Float[ndarray, "time sites"]
    noise: Float[ndarray, " sites"]
    instrument: Kind
    chain: Chain
    seed: int


@dataclass(frozen=True)
class _Wanted:
    """What is asked of a recording: the kind of instrument, these effects or a number of them, and perhaps N."""

    instrument: Kind
    effects: tuple[str, ...] | None
    count: int
    sites: int | None


def make_recording(
    seed: int,
    instrument: Kind | None = None,
    effects: Sequence[str] | None = None,
    count: int | None = None,
    sites: int | None = None,
) -> LabRecording:
    """Return a recording; the same arguments give the same one.

    Args:
        seed: decides all that is not given.
        instrument: the kind; one of `instruments.KINDS` is drawn if None.
        effects: exactly these effects; drawn if None.
        count: how many of them; 0 to `MOST_EFFECTS` if None.
        sites: N; drawn if None.

    Raises:
        InputError: no such recording could be made in `ATTEMPTS` draws.
    """
    first = np.random.default_rng([seed, 0])
    kind = KINDS[int(first.integers(len(KINDS)))]
    drawn = int(first.integers(MOST_EFFECTS + 1))
    number = len(effects) if effects is not None else drawn if count is None else count
    asked = None if effects is None else tuple(effects)
    wanted = _Wanted(kind if instrument is None else instrument, asked, number, sites)
    for attempt in range(1, ATTEMPTS + 1):
        found = _attempt(np.random.default_rng([seed, attempt]), wanted, seed)
        if found is not None:
            return found
    raise InputError(f"laboratory: seed {seed}: {ATTEMPTS} draws gave no recording with {effects or number} effects")


def _attempt(draw: np.random.Generator, wanted: _Wanted, seed: int) -> LabRecording | None:
    """Return a recording, or None where this draw gives none."""
    chain = draw_chain(draw, wanted.sites)
    instrument = draw_instrument(draw, chain.sites, wanted.instrument)
    if instrument.held:
        chain = replace(chain, start=chain.start * [[1.0], [0.0]])
    told: Ends = chain.ends
    if (chain.sites == 1 or chain.sites >= 5) and draw.uniform() < 0.35:
        told = "unknown"
    taken, recorded = instrument.times(chain.span, chain.readings, draw)
    gone = instrument.missing(len(taken), chain.sites, draw)
    experiment = Experiment(chain, instrument, taken, gone, _reach(chain, told))
    chosen = _chosen(experiment, wanted, draw)
    sized = None if chosen is None else _sized(experiment, chosen, draw)
    if chosen is None or sized is None:
        return None
    amounts, sight, border = sized
    effects = _effects(experiment, chosen, amounts, sight, border)
    if effects is None:
        return None
    taken, clean = instrument.before(taken, sight.clean, 2 * np.pi / chain.slow)
    recorded = np.concatenate([taken[: len(taken) - len(recorded)], recorded])
    noisy = instrument.read(clean, taken, sight.rms, draw)
    noise = np.sqrt(np.mean((noisy - clean) ** 2, axis=0))
    noisy[len(clean) - len(gone) :][gone] = np.nan
    kept = ~np.all(np.isnan(noisy), axis=1)
    return LabRecording(
        Samples(recorded[kept], noisy[kept], source=f"laboratory {seed}", ends=told),
        library("declared", list(chain.declared)), 2, effects,
        chain.coefficients, clean[kept], noise, wanted.instrument, chain, seed,
    )  # fmt: skip


def _reach(chain: Chain, told: Ends) -> int:
    """Return the number of sites at either end whose equation is not known."""
    if told != "unknown" or not chain.coupled:
        return 0
    return 2 if chain.sites >= LONG else 1


def _chosen(experiment: Experiment, wanted: _Wanted, draw: np.random.Generator) -> list[Ingredient] | None:
    """Return effects that the recording can tell apart, to first order; None where there are too few of them."""
    chain, reach = experiment.chain, experiment.reach
    if wanted.effects is not None:
        if not set(wanted.effects) <= set(sensible(chain, reach, ASKED)):
            return None
        return [draw_ingredient(name, chain, reach, draw) for name in wanted.effects]
    if wanted.count == 0:
        return []
    possible = sensible(chain, reach)
    weights = np.array([OFTEN.get(name, 1.0) for name in possible])
    order = draw.choice(len(possible), size=len(possible), replace=False, p=weights / weights.sum())
    pool = [draw_ingredient(possible[k], chain, reach, draw) for k in order[: wanted.count + SPARE]]
    none = np.zeros(len(pool))
    sight = experiment.look(pool, none, ROUGH, experiment.border(pool, none))
    if sight is None:
        return None
    found: list[int] = []
    for k, one in enumerate(pool):
        together = [*found, k]
        if is_held_out({pool[j].name for j in together}):
            continue
        if one.strong == 0 and one.most * sight.left(k, together) < SMALLEST:
            continue
        # With a margin: what is strong is not as it is to first order.
        if min(sight.apart(j, together) for j in together) > 2 * APART:
            found = together
        if len(found) == wanted.count:
            return [pool[j] for j in found]
    return None


def _sized(
    experiment: Experiment, chosen: Sequence[Ingredient], draw: np.random.Generator
) -> tuple[ndarray, Sight, ndarray | None] | None:
    """Return the amounts of effects, what is seen with them and of the border; None where they make no recording."""
    every = range(len(chosen))
    target = np.exp(draw.uniform(np.log(1.2 * SMALLEST), np.log(LARGEST), size=len(chosen)))
    most = np.array([one.most for one in chosen])
    strong = np.array([one.strong for one in chosen])
    amounts = np.zeros(len(chosen))
    border = experiment.border(chosen, amounts)
    for _ in range(1 + SIZINGS if len(chosen) else 0):
        sight = experiment.look(chosen, amounts, ROUGH, border)
        if sight is None:
            return None
        unit = np.array([sight.left(k, every) for k in every])
        aimed = np.where(strong > 0, strong, np.minimum(target / np.maximum(unit, 1e-300), most))
        if not np.any(amounts):
            amounts = aimed
            continue
        if np.all(np.abs(np.log(amounts / aimed)) < CLOSE):
            break
        # Not all at once: effects that are strong change what is seen of the others.
        amounts = np.minimum(amounts * np.clip(aimed / amounts, 0.25, 4) ** 0.9, most)
    border = experiment.border(chosen, amounts)
    sight = experiment.look(chosen, amounts, FINE, border)
    if sight is None or not sight.moves:
        return None
    if any(sight.size(k, every) < SMALLEST or sight.apart(k, every) < APART for k in every):
        return None
    return amounts, sight, border


def _effects(
    experiment: Experiment, chosen: Sequence[Ingredient], amounts: ndarray, sight: Sight, border: ndarray | None
) -> tuple[LabEffect, ...] | None:
    """Return what is in a recording, with the effects that would do the same in each one's place.

    None where another one would do the same in the place of two: nobody could name them.
    """
    if not chosen:
        return ()
    there = {(one.name, one.site) for one in chosen}
    others = [one for one in candidates(experiment.chain, experiment.reach) if (one.name, one.site) not in there]
    wide = experiment.look([*chosen, *others], np.concatenate([amounts, np.zeros(len(others))]), ROUGH, border)
    if wide is None:
        return None
    every = range(len(chosen))

    def does(gone: Sequence[int], j: int, least: float) -> bool:
        left, needed = wide.instead(gone, every, j)
        return left < least and needed <= others[j - len(chosen)].tangent

    beyond = range(len(chosen), len(chosen) + len(others))
    if any(does(pair, j, SMALLEST) for pair in itertools.combinations(every, 2) for j in beyond):
        return None
    found = []
    for k, one in enumerate(chosen):
        same = [others[j - len(chosen)] for j in beyond if does([k], j, ALIKE)]
        alike = tuple(sorted({other.name for other in same} - {one.name}))
        sites = {other.site for other in [one, *same] if other.name == one.name and other.site is not None}
        parameters = one.truth(float(amounts[k]))
        z, apart = float(sight.size(k, every)), float(sight.apart(k, every))
        beside = _beside(experiment, chosen, amounts) if one.name == OFFSET else {}
        found.append(LabEffect(one.name, one.site, parameters, z, apart, alike, tuple(sorted(sites)), beside))
    return tuple(found)


def _beside(experiment: Experiment, chosen: Sequence[Ingredient], amounts: ndarray) -> dict[str, float]:
    """Return the offsets of inner sensors beside outer ones that are taken as right, see `LabEffect.beside`."""
    chain, reach = experiment.chain, experiment.reach
    of = dict(zip(chain.declared, chain.coefficients, strict=True))
    for one, amount in zip(chosen, amounts, strict=True):
        of.update({one.key(name): value for name, value in one.values(float(amount)).items()})
    offsets, gains = ([of.get(f"{name}_{k + 1}", 0.0) for k in range(chain.sites)] for name in ("offset", "gain"))
    outer = [k for k in range(chain.sites) if not reach <= k < chain.sites - reach]
    if any(name.startswith(("curve", "cubic")) for name in of) or not any(offsets[k] for k in outer):
        return {}
    moved = chain.displaced(
        {k: offsets[k] / (1 + gains[k]) for k in outer}, {name: np.array([[value]]) for name, value in of.items()}
    )
    if moved is None:
        return {}
    inner = range(reach, chain.sites - reach)
    return {f"offset_{k + 1}": float(offsets[k] - (1 + gains[k]) * moved[k]) for k in inner}
