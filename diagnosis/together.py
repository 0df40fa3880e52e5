"""Effects that swing at one frequency, act at one time or at one site, and one that does what they do.

A force at one site and one at all of the same frequency, opposite to each other, move one site alone: so does the hum
of its sensor. No exchange of one effect leads from these two to that one. A force that pushes harder than all else does
what the hum of a sensor does, too. Likewise of kicks: one of all sites and one of the first of two move the second, and
several in a row do what a force does that swings for a while.

A mass that hangs beside a site and is not read is felt there as another mass or another spring, as long as it swings at
nearly one frequency, and as forces of that frequency.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Tangent
from latticebench.diagnosis.worth import pushed

# A candidate may take the place of effects if it can do this share of what they do.
MOST_OF_IT = 0.9
# What is not read may take the place of all at its site if it can do this share, its frequency being known roughly; so
# many frequencies are tried.
SOME_OF_IT, BEST = 0.5, 3
# Moments that are tried to either side of one, and nats by which another one has to do better than it does.
ABOUT, PLAINLY = 6, 1.0
# Sites that are tried in its place, to either side.
FAR = 2
# So many kicks in a row may be a wave.
ROW = 3
# Forces are of about one frequency where they differ by less than this share of it.
NEARLY = 0.03
# Forces push harder than all else where that costs more nats.
HARD = 1.0


def in_place(problem: Problem, tangent: Tangent, open_: Sequence[Placed]) -> Iterator[tuple[tuple[int, ...], Placed]]:
    """Yield the numbers of effects of a model that swing together, with the candidate that does most of what they do.

    These are any two, and any one where forces push harder than all else. Frequencies are one where they differ by less
    than half of what the longest recording resolves, times where they overlap. Besides, each may have a more general
    case (`Placed.general`), and what hangs beside a site may be in the place of several effects there, where it is
    among the candidates `open_`.
    """
    yield from _at_a_site(problem, tangent, open_)
    yield from _at_once(problem, tangent)
    yield from _in_a_row(problem, tangent)
    yield from _ringing(problem, tangent, open_)
    effects = tangent.fitted.model.effects
    swinging = [k for k, one in enumerate(effects) if one.frequency is not None]
    for k in swinging:
        alike = [one for one in problem.candidates if one.general and one.effect is effects[k].effect]
        here = [one for one in alike if one.site == effects[k].site and one.place != effects[k].place]
        others = [one.tuned(float(effects[k].frequency or 0.0)) for one in here]
        if not others:
            continue
        without = tangent.in_place_of([k])
        best = max(without.scored(others), key=lambda one: one.won)
        if best.won > without.taken + 2 * PLAINLY:
            finer = without.scored(list(best.placed.sharper()))
            yield (k,), max((best, *finer), key=lambda one: one.won).placed
    alone = [(k,) for k in swinging] if pushed(tangent.fitted) > HARD else []
    # One of each kind and place; all are tuned to the same frequency.
    waves = (one for one in problem.candidates if one.frequency is not None and not one.general)
    places = {one.place: one for one in waves} if swinging else {}
    for some in (*alone, *itertools.combinations(swinging, 2)):
        omega = [float(effects[k].frequency or 0.0) for k in some]
        # One of two may do the work of both.
        there = {effects[k].place for k in some} if len(some) == 1 else set()
        others = [one.tuned(float(np.mean(omega))) for place, one in places.items() if place not in there]
        if np.ptp(omega) > np.pi / problem.scene.span or not others:
            continue
        without = tangent.in_place_of(some)
        best = max(without.scored(others), key=lambda one: one.won)
        if best.won > MOST_OF_IT * without.taken > 0:
            yield some, best.placed


def _at_once(problem: Problem, tangent: Tangent) -> Iterator[tuple[tuple[int, ...], Placed]]:
    """Yield the numbers of one or two effects that act for a while, with one that does so elsewhere or a little off.

    A pulse a wave too late does part of what the true one does, and another kind may do more of it.
    """
    effects = tangent.fitted.model.effects
    moments = {k: one.moment for k, one in enumerate(effects) if one.moment is not None}
    places = {one.place: one for one in problem.candidates if one.moment is not None} if moments else {}
    for some in (*((k,) for k in moments), *itertools.combinations(moments, 2)):
        times, widths = zip(*(moments[k] for k in some), strict=True)
        if np.ptp(times) > sum(widths):
            continue
        there, sites = moments[some[0]], [effects[k].site for k in some]
        near = [one for one in places.values() if one.site is None or any(_beside(one.site, site) for site in sites)]
        others = [one.at_moment(each) for one in near for each in _about(problem, there)]
        if not others:
            continue
        without = tangent.in_place_of(some)
        best = max(without.scored(others), key=lambda one: one.won)
        enough = MOST_OF_IT * without.taken if len(some) > 1 else without.taken + 2 * PLAINLY
        if best.won > enough > 0:
            yield some, best.placed


def _in_a_row(problem: Problem, tangent: Tangent) -> Iterator[tuple[tuple[int, ...], Placed]]:
    """Yield the numbers of all effects that act for a while at one place, with what swings there as long as they do."""
    effects = tangent.fitted.model.effects
    moments = {k: one.moment for k, one in enumerate(effects) if one.moment is not None}
    for site in {effects[k].site for k in moments}:
        here = tuple(k for k in moments if effects[k].site == site)
        if len(here) < ROW:
            continue
        ends = [moments[k][0] + sign * moments[k][1] for k in here for sign in (-1, 1)]
        every = (one.lasting(min(ends), max(ends)) for one in problem.candidates if one.site == site)
        places = {one.place: one for one in every if one is not None}
        others = [one.tuned(float(omega)) for one in places.values() for omega in problem.scene.frequencies]
        without = tangent.in_place_of(here)
        for one in sorted(without.scored(others), key=lambda one: -one.won)[:BEST]:
            if one.won > SOME_OF_IT * without.taken > 0:
                yield here, one.placed


def _beside(site: int, other: int | None) -> bool:
    """Return whether a site is one that a kick may have come to instead."""
    return other is None or abs(site - other) <= FAR


def _about(problem: Problem, moment: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Yield moments about one, as far as half a wave to either side."""
    (at, width), wave = moment, 2 * np.pi / problem.scene.top
    for shift in wave * np.linspace(-0.5, 0.5, 2 * ABOUT + 1):
        yield at + float(shift), width


def _ringing(problem: Problem, tangent: Tangent, open_: Sequence[Placed]) -> Iterator[tuple[tuple[int, ...], Placed]]:
    """Yield the numbers of all forces on every site of about one frequency, with what may carry the sites and ring.

    What rings by itself pushes as a force does that dies away, whatever its mass: a score does not know it. A force
    dies away where another one of nearly its frequency is there besides, or would be worth its price.
    """
    effects, chain = tangent.fitted.model.effects, problem.chain
    swinging = {k: abs(one.frequency) for k, one in enumerate(effects) if one.frequency and one.site is None}
    forces = {k: omega for k, omega in swinging.items() if {one.text for one in effects[k].forces(chain)} == {"1"}}
    carriers = [one for one in open_ if one.site is None and one.resonator(chain) is not None]
    carried = any(one.site is None and one.resonator(chain) is not None for one in effects)
    for first, omega in forces.items() if carriers and not carried else ():
        alike = tuple(k for k, other in forces.items() if abs(other - omega) <= NEARLY * omega)
        if first == alike[0] and (len(alike) > 1 or _dies_away(problem, tangent, effects[first])):
            yield alike, carriers[0].tuned(omega)


def _dies_away(problem: Problem, tangent: Tangent, force: Placed) -> bool:
    """Return whether a force of nearly the frequency of one in the model would be worth its price besides."""
    omega, lines = abs(force.frequency or 0.0), np.pi / problem.scene.span * np.array([-2, -1, 1, 2])
    waves = [one for one in problem.candidates if one.place == force.place][:1]
    near = [omega + float(line) for line in (*lines, -NEARLY * omega, NEARLY * omega)]
    others = tangent.scored([one.tuned(omega) for one in waves for omega in near])
    return max((one.gain for one in others), default=0.0) > problem.price_of(force)


def _at_a_site(problem: Problem, tangent: Tangent, open_: Sequence[Placed]) -> Iterator[tuple[tuple[int, ...], Placed]]:
    """Yield the numbers of all effects of a model at a site, where there are several, with what may hang there."""
    effects, chain = tangent.fitted.model.effects, problem.chain
    for site in range(chain.sites):
        here = tuple(k for k, one in enumerate(effects) if one.site == site and not one.instrument)
        if len(here) < 2:
            continue
        coarse = [one for one in open_ if one.site == site and one.resonator(chain) is not None]
        hanging = [each for one in coarse for each in (one, *one.sharper())]
        without = tangent.in_place_of(here)
        scored = sorted(without.scored(hanging), key=lambda one: -one.won) if hanging else []
        for one in scored[:BEST]:
            if one.won > SOME_OF_IT * without.taken > 0:
                yield here, one.placed
