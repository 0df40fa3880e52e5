"""The search: from short pieces, where a wrong equation can follow, too, to whole recordings.

At each horizon the best models are opened: every candidate is ranked by its score, the best few are fitted with all
that was accepted before, and effects that have become doubtful are tried without. The best models go on to the next
horizon.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from latticebench.diagnosis import lengths, noise_parts, rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.glance import crowding, most_promising, restless
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.inputs import finest, interpolations, likeliest
from latticebench.diagnosis.mirrored import images, mirrored
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.moments import beside
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.past import past_of, settled, with_known, with_unread
from latticebench.diagnosis.pool import Pool
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.progress import Found, Horizon, Tried
from latticebench.diagnosis.readout import unread
from latticebench.diagnosis.regression import regressed, sustained
from latticebench.diagnosis.rounding import without_rounding
from latticebench.diagnosis.score import Scored, Tangent
from latticebench.diagnosis.together import MOST_OF_IT, in_place
from latticebench.diagnosis.worth import Worth, beyond, fine, misfits, over, surprises, unlikely, wald

Watcher = Callable[[str], None]

# Errors of the integrator become smaller where what is left does by this factor.
FINER = 4.0
# Nats that dry friction which jumps must bring beside one that is viscous at low speeds.
HELPED = 0.5
# Gauss-Newton steps of a first fit, of one at the next horizon, and of one with an effect more or less.
FIRST, CARRIED, CHANGED = 40, 25, 10
# A model that cannot be followed over long pieces at once begins on the second horizon and climbs so many at a time.
CLIMBING = 2
# An effect is tried without where its own uncertainty leaves less than so many nats beyond its price.
DOUBT = 8.0


class Search:
    """A search for what an equation lacks."""

    def __init__(self, problem: Problem, watcher: Watcher) -> None:
        self.problem, self.say = problem, watcher
        self.structure = Structure()
        self.small, self.memory, self.everywhere = fine(problem), 0.0, max(len(one.t) for one in problem.data)
        self.tried: dict[tuple[str, ...], tuple[Tried, ...]] = {}
        self.open: tuple[Placed, ...] = problem.candidates
        self.lengths: list[int] = []
        self.worth = Worth(problem)
        self._last: Tangent | None = None

    def value(self, fitted: Fitted) -> float:
        """Return the cost of a fit with the prices of its effects and of the noise's parameters, in nats."""
        return self.worth.value(fitted)

    def horizons(self) -> Iterator[Found]:
        """Yield what was found on each horizon, from short pieces to whole recordings.

        Where no model can be followed further, the last horizon comes again, with what acts at times of its own.
        """
        done: tuple[Horizon, ...] = ()
        last: Found | None = None
        stuck = opened = False
        shortest = 2 * np.pi / self.problem.fastest / self.problem.step
        length = max(int(rules.FIRST_HORIZON * shortest), lengths.least(self.problem))
        carried = self._first(length)
        if longer := self._at_once(carried):
            carried, length = longer, lengths.longest(self.problem)
        while carried:
            self.lengths.append(length)
            whole = length >= lengths.longest(self.problem)
            waves = length * self.problem.step * self.problem.main / (2 * np.pi)
            strays = last is not None and misfits(self.problem, last.models[0], anywhere=True)
            long = whole or waves >= rules.PERIODS
            late = long or stuck or strays or self.problem.relaxes
            self.open = tuple(one for one in self.problem.candidates if (long if one.slow else late or not one.timed))
            before, fits = carried[0], list(carried[1:])
            if late and not opened:
                begun = (self._begun(one, self.problem, fits[0].layout) for one in self._sustained)
                fits += [one for one in begun if one is not None]
            opened = late
            self.say(f"following pieces of {waves:.3g} periods")
            best = self._level(fits, before)
            base = self.value(best[0])
            models = tuple((one.model.names, self.value(one) - base) for one in best)
            tried, misfit = self.tried.get(best[0].model.key, ()), misfits(self.problem, best[0])
            done = (*done, Horizon(best[0].longest, waves, models, tried, misfit))
            stays = last is not None and last.models[0].model.key == best[0].model.key
            sure = stays and beyond(self.problem, best[0]) < rules.LOST
            last = Found(before, tuple(best), done, whole)
            yield last
            further = lengths.longer(self.problem, length, sure)
            followed = [one for one in (before, *best) if one.longest == best[0].longest]
            if not further and (finer := without_rounding(self.problem, followed, self.value)) is not None:
                self.problem, further = finer, [lengths.longest(self.problem)]
                self.say("taking away what rounding adds to the readings")
            carried, length = self._ahead(last, further, length)
            stuck = not carried and not late
            if stuck:
                carried = [before, *best]
                self.say("no model can be followed further: looking for what acts at times of its own, too")

    def _ahead(self, last: Found, further: Sequence[int], length: int) -> tuple[list[Fitted], int]:
        """Return the models on the first of longer horizons where they can be followed, none if there is none.

        Where they follow what was looked at, but no more than that, all is looked at on this horizon first.
        """
        for longer in further:
            before = self.problem
            if carried := self._carried(last, longer):
                if length < self.everywhere and surprises(before, last.models[0], carried[1:]):
                    after, self.problem, self.everywhere = self.problem, before, length
                    if again := self._carried(last, length):
                        return again, length
                    self.problem = after
                return carried, longer
        return [], length

    def _at_once(self, first: list[Fitted]) -> list[Fitted]:
        """Return the first fits on the longest pieces if the declared equation alone nearly follows these.

        The parts of the noise model are those that short pieces show: on long ones, what is missing looks like noise
        with a memory. On long pieces there may be several best fits near by, a wave of a weak mode apart: the declared
        equation comes there at once, from what the regression gives it, and by way of all lengths between; not where
        the ends are unknown, for the curves of the outer sites are others at each length, and take long to find.
        """
        if not first:
            return []
        whole, border = lengths.longest(self.problem), len(self.problem.plain.border) > 0
        ways = [self._begun(self._declared, self.problem, self.layout(whole), CHANGED)]
        ways += [] if border else [self._led(first[0], whole)]
        found = min((one for one in ways if one is not None), key=lambda one: one.cost, default=None)
        if found is None or not found.converged:
            return []
        ratio = over(self.problem, found)
        if not np.any(np.isfinite(ratio)) or np.sqrt(np.nanmean(ratio**2)) > rules.AT_ONCE:
            return []
        return self._laid([found, *(one for one in first if one.model.effects)], found, whole)

    def _led(self, found: Fitted | None, length: int) -> Fitted | None:
        """Return the fit of a model on pieces of a length, by way of all between; None where the way ends before."""
        asked = length if found is None else found.longest
        # Where there are gaps, pieces are shorter than what is asked for.
        while found is not None and asked < length:
            (asked,) = lengths.longer(self.problem, asked, sure=False)
            found = self.carry(found, self.layout(asked))
        return found

    @functools.cached_property
    def _declared(self) -> Model:
        """The declared equation, with the numbers that a regression gives it."""
        return Model(self.problem.declared, self.problem.order, regressed(self.problem)[0])

    @functools.cached_property
    def _sustained(self) -> list[Model]:
        """The declared equation with forces from outside at lines of the spectrum."""
        return sustained(self.problem)

    def _begun(self, model: Model, seen: Problem, layout: Layout, steps: int = FIRST) -> Fitted | None:
        """Return the first fit of a model, from smoothed readings as they are seen."""
        near = [nodes[rows] for nodes, rows in zip(seen.nodes, layout.rows, strict=True)]
        return self.refit(model, layout.with_substeps(model, near, self.problem.top), near, None, steps)

    def layout(self, length: int, problem: Problem | None = None) -> Layout:
        """Return pieces of a length: of all rows on long horizons, of some on short ones, unless asked for."""
        most = None if length >= min(self.everywhere, lengths.longest(self.problem)) else lengths.looked_at(length)
        return Layout.of(problem or self.problem, length, most, self.small, self.memory)

    def _first(self, length: int) -> list[Fitted]:
        """Return the declared equation, and the rivals that begin the search."""
        problem = self.problem
        layout, start = self.layout(length), self._declared
        still = replace(start, coefficients=(0.0,) * len(start.coefficients))
        fits: list[Fitted] = []
        at_once = [(start.with_effect(one), problem) for one in problem.candidates if one.from_the_start]
        for model, seen in ((start, problem), (still, problem), *at_once, *mirrored(problem, start)):
            if model is still and fits:
                continue
            found = self._begun(model, seen, layout)
            fits += [found] if found is not None else []
        if not fits:
            return []
        self.small = fine(self.problem, fits[0])
        self.structure, self.memory = noise_parts.shown(self.problem, fits[0])
        return [fits[0], *fits]

    def _carried(self, last: Found, length: int) -> list[Fitted]:
        """Return the declared equation and the best models on a longer horizon."""
        self.small = fine(self.problem, last.models[0])
        self.structure, self.memory = noise_parts.shown(self.problem, last.models[0])
        return self._laid(last.models, last.before, length, early=len(last.horizons) == 1)

    def _laid(self, models: Sequence[Fitted], before: Fitted, length: int, *, early: bool = False) -> list[Fitted]:
        """Return the declared equation, `before` until now, and other models on pieces of a length, the best first."""
        laid, carry = functools.partial(self.layout, length), functools.partial(self.carry, models[0])
        on_inputs = interpolations(self.problem, early=early)
        border = len(self.problem.plain.border) > 0
        if len(on_inputs) > 1 or not border:
            self.problem, best = likeliest(on_inputs, lambda one: carry(laid(one)))
        if border:
            self.problem, best = finest(self.problem, laid, carry)
        layout = self.layout(length) if best is None else best.layout
        more = (self.carry(one, layout) for one in models[1:])
        fits = [found for found in (best, *more) if found is not None]
        if not fits:
            return []
        plain = next((one for one in fits if not one.model.effects), None) or self.carry(before, layout)
        return [plain or before, *fits]

    def carry(self, fitted: Fitted, layout: Layout, steps: int = CARRIED, hope: float = np.inf) -> Fitted | None:
        """Return a model on another layout, from where it ended."""
        near = []
        for number, rows in enumerate(layout.rows):
            nodes = np.array(unread(fitted.model, layout, number, self.problem.nodes[number]))
            old, valid = fitted.layout.rows[number], fitted.layout.valid[number]
            nodes[old[valid]] = fitted.followed.nodes[number][valid][:, : layout.plain.read]
            near.append(with_known(fitted, number, nodes)[rows])
        ready = layout.with_substeps(fitted.model, near, self.problem.top)
        return self.refit(fitted.model, ready, near, fitted, steps, hope)

    def refit(
        self,
        model: Model,
        layout: Layout,
        near: list[np.ndarray] | tuple[np.ndarray, ...],
        start: Fitted | None,
        steps: int,
        hope: float = np.inf,
    ) -> Fitted | None:
        """Return the fit of a model; None where it cannot be followed or comes to no cost below `hope`.

        Dry friction is viscous at low speeds at first, and jumps after that if it fits better so; where the fit that
        this one starts from has been through that, it has to come below `hope` before.
        """
        if not model.rubs:
            return self._refit(model, layout, near, start, steps, hope)
        near = with_unread(self.problem, layout, model, near)
        known = soft = self.problem.plain.rest
        least = np.inf
        if start is not None and start.model.rubs:
            known, least = start.layout.plain.rest, hope
        found = None
        for rest in sorted({known, soft}):
            if found is None:
                resting = layout.resting(rest).with_substeps(model, near, self.problem.top)
                found = self._refit(model, resting, near, start, steps, least)
        if found is not None and found.layout.plain.rest > 0:
            abrupt = found.layout.resting(0.0).with_substeps(found.model, found.followed.nodes, self.problem.top)
            found = self._refit(found.model, abrupt, found.followed.nodes, found, steps, found.cost - HELPED) or found
        return found if found is not None and found.cost < hope else None

    def _refit(
        self,
        model: Model,
        layout: Layout,
        near: list[np.ndarray] | tuple[np.ndarray, ...],
        start: Fitted | None,
        steps: int,
        hope: float = np.inf,
    ) -> Fitted | None:
        noise = None if start is None else start.noise
        known = start is not None and start.layout.borders is layout.borders
        splines = start.followed.splines if start is not None and known else None
        with np.errstate(all="ignore"):
            try:
                found = settled(
                    self.problem, model, layout, near,
                    structure=self.structure, noise=noise, steps=steps, hope=hope, splines=splines,
                )  # fmt: skip
            except np.linalg.LinAlgError:
                return None
        small = layout.small if found is None else fine(self.problem, found)
        if found is None or small > layout.small / FINER:
            return found
        # What is left has become so little that the integrator's errors count.
        finer = replace(layout, small=small).with_substeps(found.model, found.followed.nodes, self.problem.top)
        return self._refit(found.model, finer, found.followed.nodes, found, steps, hope)

    # One horizon ------------------------------------------------------------------------------------------------------

    def _level(self, fits: list[Fitted], before: Fitted) -> list[Fitted]:
        """Return the best models of a horizon, where the declared equation alone leads to `before`."""
        # The declared equation is opened last, if it can be followed: one effect may do what several of a model do.
        last = [before] if before.longest == fits[0].longest else []
        pool = Pool(self.problem, [*fits, *last])
        self.worth = pool.worth
        opened: set[tuple[str, ...]] = set()
        while todo := [one for one in (*pool.leading(), *last) if one.model.key not in opened]:
            opened.add(todo[0].model.key)
            leader = pool.leading()[0]
            ahead = np.inf if todo[0] is leader else self.value(leader)
            for found in self._neighbours(todo[0], pool, ahead):
                pool.keep(found)
                self.worth = pool.worth
        return pool.leading()

    def _neighbours(self, fitted: Fitted, pool: Pool, ahead: float) -> Iterator[Fitted]:
        """Yield models with a doubtful effect less, and with one of the best candidates more.

        A rival's candidate is fitted where its score could bring the rival to the front, past the value `ahead`.
        """
        here, own = self.value(fitted), Worth(self.problem, fitted)
        model = fitted.model
        for number in range(len(model.effects)):
            if model.without(number) not in pool and not self._sure(fitted, number):
                hope = fitted.cost + fitted.dispersion * (own.price_of(model.effects[number]) + unlikely(fitted))
                found = self.without(fitted, number, hope)
                if found is not None:
                    yield found
        yield from self._exchanged(fitted, pool)
        for other, near in (*images(self.problem, fitted), *beside(self.problem, fitted)):
            found = None if other in pool else self.refit(other, fitted.layout, near, fitted, CHANGED)
            if found is not None:
                yield found
        if len(model.effects) < rules.MOST_EFFECTS:
            timed = ahead == np.inf or not model.effects
            start, likely = self._likely(fitted, timed)
            # What leads may swing as a single site would itself. Then little speaks for the true force alone.
            bare = not model.effects and self.problem.chain.sites == 1 and pool.leading()[0].model.may_stand_in
            for one in likely[: rules.TRIED]:
                gain = rules.UNDERSTATED * one.gain / fitted.dispersion
                force = bare and one.placed.frequency is not None
                hopeless = here - gain + own.price_of(one.placed) > ahead and not force
                found = pool.find(model.with_effect(one.placed))
                if found is None and not hopeless:
                    found = self.with_effect(start, one.placed)
                    if found is None or not Worth(self.problem, found).better(found, fitted):
                        continue
                    yield found
                if found is not None and force:
                    yield from self._grown(found, pool)

    def _grown(self, fitted: Fitted, pool: Pool) -> Iterator[Fitted]:
        """Yield a model with the best candidate more, and again; nothing with a frequency or a time of its own."""
        while len(fitted.model.effects) < rules.MOST_EFFECTS:
            asked = dict(self.tried)
            start, likely = self._likely(fitted, timed=False)
            # What a model was asked when it was opened is more than this.
            self.tried |= asked
            if not likely:
                return
            found = pool.find(fitted.model.with_effect(likely[0].placed)) or self.with_effect(start, likely[0].placed)
            if found is None or not Worth(self.problem, found).better(found, fitted):
                return
            yield found
            fitted = found

    def _likely(self, fitted: Fitted, timed: bool) -> tuple[Fitted, list[Scored]]:
        """Return the candidates whose score is above their price, and the fit that this is so for.

        Noise with a long memory, or common to all sensors, does the work of forces: where it leaves no candidate, it is
        taken as white.
        """
        found = self.screened(fitted, timed=timed)
        if found or not noise_parts.hides(fitted.noise, self.problem.step):
            return fitted, found
        tried, white = self.tried[fitted.model.key], replace(fitted, noise=noise_parts.white(fitted.noise))
        found, self.tried[fitted.model.key] = self.screened(white, timed=timed), tried
        return white, found

    def _exchanged(self, fitted: Fitted, pool: Pool) -> Iterator[Fitted]:
        """Yield models with a likelier effect in the place of one, or of two that swing together."""
        effects, every = fitted.model.effects, []
        for number, placed in enumerate(effects):
            found = [one for one in self.standing_in(fitted, number) if self._rather(one, placed)]
            every += [((number,), one.placed) for one in found[:2]]
        for numbers, one in (*every, *in_place(self.problem, self.tangent(fitted), self.open)):
            model = functools.reduce(Model.without, sorted(numbers, reverse=True), fitted.model).with_effect(one)
            if model not in pool:
                own = Worth(self.problem, fitted)
                cheaper = sum(own.price_of(effects[k]) for k in numbers) - own.price_of(one)
                hope = fitted.cost + fitted.dispersion * (max(cheaper, 0.0) + unlikely(fitted))
                other = self.exchanged(fitted, numbers, one, hope)
                if other is not None:
                    yield other

    def _rather(self, one: Scored, placed: Placed) -> bool:
        """Return whether a candidate is to be tried in the place of an effect."""
        more = one.gain + self.problem.price_of(placed) - self.problem.price_of(one.placed)
        return one.placed.count < placed.count or more > 1

    def _sure(self, fitted: Fitted, number: int) -> bool:
        """Return whether an effect is beyond doubt by its numbers and their covariance."""
        if not fitted.model.effects[number].strength:
            return False
        return wald(fitted, number) > Worth(self.problem, fitted).price_of(fitted.model.effects[number]) + DOUBT

    def without(self, fitted: Fitted, number: int, hope: float = np.inf) -> Fitted | None:
        """Return the fit without one effect; None where it comes to no cost below `hope`."""
        return self.refit(fitted.model.without(number), fitted.layout, fitted.followed.nodes, fitted, CHANGED, hope)

    def with_effect(self, fitted: Fitted, placed: Placed) -> Fitted | None:
        """Return the fit with one effect more, from its score's numbers or, where these lead astray, from a tenth."""
        if placed.wandering() is not None:
            model = fitted.model.with_effect(placed)
            return self.refit(model, fitted.layout, fitted.followed.nodes, fitted, CHANGED, fitted.cost)
        numbers = placed.numbers
        weaker = numbers.copy()
        weaker[: len(placed.strength)] *= 0.1
        for start in (numbers, weaker) if len(placed.strength) else (numbers,):
            model, near = self.tangent(fitted).start(placed.moved(start))
            found = self.refit(model, fitted.layout, near, fitted, CHANGED, fitted.cost)
            if found is not None:
                return found
        return None

    def exchanged(self, fitted: Fitted, numbers: Sequence[int], placed: Placed, hope: float) -> Fitted | None:
        """Return the fit with another effect in the place of some; None where it comes to no cost below `hope`."""
        model, near = self.tangent(fitted).start(placed, numbers)
        return self.refit(model, fitted.layout, near, fitted, CHANGED, hope)

    def climbed(self, model: Model, fitted: Fitted, hope: float) -> Fitted | None:
        """Return the fit of a model from short pieces up to those of another fit; None where the way ends before.

        On shorter pieces of the same readings, which have more starts of their own, it costs less: where that is above
        `hope` already, the way ends.
        """
        found, readings = None, fitted.layout.readings()
        for length in self.lengths[1:-1:CLIMBING]:
            layout = self.layout(length)
            if found is None:
                every = (unread(model, layout, number, nodes) for number, nodes in enumerate(self.problem.nodes))
                seen = [nodes[rows] for nodes, rows in zip(every, layout.rows, strict=True)]
                near = with_unread(self.problem, layout, model, seen)
                ready = layout.with_substeps(model, near, self.problem.top)
                found = self.refit(model, ready, near, fitted, FIRST)
            else:
                found = self.carry(found, layout)
            if found is None or (found.cost > hope and layout.readings() == readings):
                return None
        return None if found is None else self.carry(found, fitted.layout, hope=hope)

    def standing_in(self, fitted: Fitted, number: int) -> list[Scored]:
        """Return candidates that could do most of what one effect does, one of each name, the best first.

        Their gain is by how many nats they would do better.
        """
        placed = fitted.model.effects[number]
        if not placed.strength or (placed.timed and not placed.fed):
            return []
        present = {one.place for one in fitted.model.effects}
        absent = [one for one in self.open if one.place not in present and not one.timed]
        tangent = self.tangent(fitted).in_place_of([number])
        best: dict[tuple[object, ...], Scored] = {}
        for one in sorted(tangent.scored(absent), key=lambda one: -one.won):
            if one.won > MOST_OF_IT * tangent.taken > 0:
                better = replace(one, gain=(one.won - tangent.taken) / 2)
                best.setdefault((one.placed.effect.name, len(one.placed.strength)), better)
        return list(best.values())

    def tangent(self, fitted: Fitted) -> Tangent:
        """Return the tangent of a fit; that of the last one is kept."""
        if self._last is None or self._last.fitted is not fitted:
            self._last = Tangent(fitted)
        return self._last

    def screened(self, fitted: Fitted, *, timed: bool = True) -> list[Scored]:
        """Return the candidates whose score is above their price, the best first."""
        hanging = fitted.model.hanging(fitted.chain)
        present = {one.place for one in fitted.model.effects if not one.timed or one in hanging}
        every = [one for one in self.open if one.place not in present and not one.general]
        absent = [one for one in every if not one.timed]
        tangent, own = self.tangent(fitted), Worth(self.problem, fitted)
        if timed:
            past = past_of(self.problem, fitted.layout, fitted.model, fitted.followed.nodes)
            courses = [one.with_past(past) for one in every if one.timed and one.wandering() is None]
            absent += most_promising(tangent, courses, self.problem.price_of, lambda one: one.effect.name)
        best: dict[tuple[object, ...], tuple[float, Scored]] = {}
        tried: dict[str, Tried] = {}
        for one in (*tangent.scored(absent), *(restless(fitted, self.open) if timed else ())):
            name = one.placed.effect.name
            price = self.problem.price(name, one.freedom)
            if one.placed.frequency is not None and one.gain > price:
                price *= max(1.0, crowding(tangent, one.placed, self.open) / fitted.dispersion)
            key, whole = one.placed.place, own.price_of(one.placed) * fitted.dispersion
            asked = max(price, whole)
            if name not in tried or one.gain - asked > tried[name].gain - tried[name].price:
                tried[name] = Tried(name, one.gain, asked)
            hopeful = one.gain > max(price, whole / rules.UNDERSTATED)
            if one.freedom and hopeful and (key not in best or one.gain - price > best[key][0]):
                best[key] = (one.gain - price, one)
        self.tried[fitted.model.key] = tuple(sorted(tried.values(), key=lambda one: one.price - one.gain))
        return [one for _, one in sorted(best.values(), key=lambda pair: -pair[0])]
