"""Effects that act through what the chain's present state lacks: its past, something hidden, an input, other inertia.

Each function returns the clean readings of a chain with an amount of the effect.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults.pushes import Moment, between
from latticebench.bench.trials.faults.setting import Fields, Setting, integrated

if TYPE_CHECKING:
    from numpy import ndarray


def memory(setting: Setting, amount: complex) -> Fields:
    """Push each site by amount u(t - delay)."""
    return _with_past(setting, lambda past, _: amount * past)


def retarded_coupling(setting: Setting, amount: complex) -> Fields:
    """Couple each site to its neighbours as they were a delay ago."""

    def late(past: ndarray, u: ndarray) -> ndarray:
        before = Moment(0.0, past, past, setting.chain, setting.drawn)
        return np.asarray(amount * (before.neighbour(1) + before.neighbour(-1) - 2 * u))

    return _with_past(setting, late)


def side_resonator(setting: Setting, amount: complex) -> Fields:
    """Hang a resonator on one site."""
    return _with_resonators(setting, amount, setting.one[None], float(setting.drawn.about["own"]))


def side_mass(setting: Setting, amount: complex) -> Fields:
    """Hang a mass on one site by a spring; the amount is in units of the site's mass."""
    own = float(setting.drawn.about["own"])
    return _with_resonators(setting, amount * own**2, setting.one[None], own)


def swaying_mount(setting: Setting, amount: complex) -> Fields:
    """Let the mount that all sites stand on sway."""
    hung = np.ones((1, setting.chain.sites))
    return _with_resonators(setting, amount, hung, float(setting.drawn.about["sway"]))


def swaying_support(setting: Setting, amount: complex) -> Fields:
    """Let a support sway that carries all sites, which are read as it sees them.

    The amount is the mass of a site in units of the support's.
    """
    chain, own, mass = setting.chain, float(setting.drawn.about["sway"]), float(np.real(amount))
    rate, sites = chain.right_hand_side, chain.parts * chain.sites

    def carried(t: float, y: ndarray) -> ndarray:
        change = rate(t, y[:-2])
        sway = -(own**2) * y[-2] - mass * np.sum(change[-sites:])
        change[-sites:] -= sway
        return np.concatenate([change, [y[-1], sway]])

    start = np.concatenate([setting.start, [0.0, 0.0]])
    return chain.unpack(integrated(carried, start, setting.times)[:-2])


def inner_resonators(setting: Setting, amount: complex) -> Fields:
    """Let each site have a resonator inside, all of them alike."""
    return _with_resonators(setting, amount, np.eye(setting.chain.sites), float(setting.drawn.about["own"]))


def slow_heating(setting: Setting, amount: complex) -> Fields:
    """Let what moves warm its site, which gives the heat off again; the force of a warm site is another."""
    cooling = float(setting.drawn.about["cooling"])
    return _with_hidden(setting, lambda heat, u: amount * heat * u, lambda heat, v: (np.abs(v) ** 2 - heat) / cooling)


def slipping_spring(setting: Setting, amount: complex) -> Fields:
    """Let each site drag a spring whose foot slips: its bend follows the site when small, and never passes the grip."""
    grip = float(setting.drawn.about["grip"])
    return _with_hidden(setting, lambda bend, _: -amount * bend, lambda bend, v: v - np.abs(v) * bend / grip)


def known_input(setting: Setting, amount: complex) -> Fields:
    """Push each site by its drawn input."""
    from scipy.interpolate import CubicSpline

    force = CubicSpline(setting.times, setting.drawn.force)
    return setting.run(lambda t, _u, _v: amount * force(t))


def unequal_masses(setting: Setting, amount: complex) -> Fields:
    """Scale one site's whole right-hand side by 1 + amount."""
    return setting.run(lambda t, u, v: np.asarray(float(np.real(amount)) * setting.one * setting.own_rate(t, u, v)))


def shared_inertia(setting: Setting, amount: complex) -> Fields:
    """Return bonds a mass: u'' = F becomes u'' - amount (u''_{n+1} + u''_{n-1} - 2 u''_n) = F; with u' for order 1."""
    chain, drawn = setting.chain, setting.drawn
    own = np.eye(chain.sites)
    differences = np.stack([between(Moment(0.0, one, one, chain, drawn)) for one in own], axis=1)
    shared = np.linalg.inv(own - float(np.real(amount)) * differences) - own
    return setting.run(lambda t, u, v: np.asarray(shared @ setting.own_rate(t, u, v)))


def end_stops(setting: Setting, amount: complex) -> Fields:
    """Put padded stops round each site where it stands at the start; beyond its play it is pushed back."""
    begin, play = setting.chain.unpack(setting.start)[0], float(setting.drawn.about["play"])

    def stopped(_t: float, u: ndarray, _v: ndarray) -> ndarray:
        moved = u - begin
        return np.asarray(-amount * moved * (1 - play / np.maximum(np.abs(moved), play)))

    return setting.run(stopped)


def viscoelastic_bonds(setting: Setting, amount: complex) -> Fields:
    """Couple neighbours by rubber, too, that gives way: amount times the second difference of u - w.

    Here w' = (u - w) / relaxing; the rubber is relaxed at the start.
    """
    chain, drawn, relaxing = setting.chain, setting.drawn, float(setting.drawn.about["relaxing"])

    def both(_t: float, rest: ndarray, u: ndarray, _v: ndarray) -> tuple[ndarray, ndarray]:
        left = u - rest
        moment = Moment(0.0, left, left, chain, drawn)
        return amount * (moment.stretch(1) + moment.stretch(-1)), left / relaxing

    return _with_unseen(setting, chain.unpack(setting.start)[0], both)


def fatiguing_bonds(setting: Setting, amount: complex) -> Fields:
    """Let each bond weaken for good by amount d, where d' is the square of its stretch."""

    def both(_t: float, borne: ndarray, u: ndarray, _v: ndarray) -> tuple[ndarray, ndarray]:
        stretch = np.diff(u)
        lost = np.pad(borne * stretch, 1)
        return -amount * np.diff(lost), np.abs(stretch) ** 2

    return _with_unseen(setting, np.zeros(setting.chain.sites - 1), both)


def holding_loop(setting: Setting, amount: complex) -> Fields:
    """Let a servo hold the mean m of all sites: it pushes each by -amount times the integral of m(t) - m(0)."""
    held = np.mean(setting.chain.unpack(setting.start)[0])

    def both(_t: float, summed: ndarray, u: ndarray, _v: ndarray) -> tuple[ndarray, ndarray]:
        return np.asarray(-amount * summed * np.ones(len(u))), np.full(1, np.mean(u) - held)

    return _with_unseen(setting, np.zeros(1, np.asarray(held).dtype), both)


def parallel_chain(setting: Setting, amount: complex) -> Fields:
    """Let a second chain like this one lie beside it, out of sight.

    A site u and the site w opposite pull at each other by amount (w - u). The second chain starts as the first does,
    moved along by a few sites.
    """
    chain = setting.chain
    rate, size = chain.right_hand_side, chain.parts * chain.sites
    moved = np.clip(np.arange(chain.sites) + int(setting.drawn.about["aside"]), 0, chain.sites - 1)
    u0, v0 = chain.unpack(setting.start)

    def both(t: float, beside: ndarray, u: ndarray, _v: ndarray) -> tuple[ndarray, ndarray]:
        pull, change = amount * (chain.unpack(beside)[0] - u), rate(t, beside)
        change[-size:] -= setting.parts(pull)
        return pull, change

    return _with_unseen(setting, chain.pack(u0[moved], None if v0 is None else v0[moved]), both)


def bent_wire(setting: Setting, amount: complex) -> Fields:
    """Thread each site like a bead on a bent wire: (1 + amount u^2) u'' + amount u u'^2 = F.

    Its inertia grows away from 0.
    """
    bent = float(np.real(amount))

    def push(t: float, u: ndarray, v: ndarray) -> ndarray:
        own = setting.own_rate(t, u, v)
        return np.asarray((own - bent * u * v**2) / (1 + bent * u**2) - own)

    return setting.run(push)


def ends(setting: Setting, _amount: complex) -> Fields:
    """Return the chain the ends that it is not declared to have."""
    return setting.other_ends().run()


def _with_resonators(setting: Setting, amount: complex, hung: ndarray, own: float) -> Fields:
    """Return the readings with unseen things, each of which pulls some sites by amount (w - m).

    Here w is its own place, and m the mean of its sites. Its motion is w'' = own^2 (m - w), or w' = own (m - w), times
    i for a complex field; it starts as they do.

    Args:
        setting: the chain.
        amount: strength of the pull.
        hung: 1 at the sites of each thing, 0 elsewhere (things, N).
        own: frequency of the things.
    """
    chain = setting.chain
    rate, size = chain.right_hand_side, chain.parts * chain.sites
    turn = 1j if chain.is_complex else 1.0
    share = hung / np.sum(hung, axis=1, keepdims=True)
    # Each has a place and a speed, with two parts each.
    unseen = 4 * len(hung)

    def coupled(t: float, y: ndarray) -> ndarray:
        change, mean = rate(t, y[:-unseen]), share @ chain.unpack(y[:-unseen])[0]
        w, speed = np.split(y[-unseen:].view(complex), 2)
        pull = amount * (w - mean) @ hung
        change[-size:] += setting.parts(pull if chain.is_complex else pull.real)
        hidden = [speed, own**2 * (mean - w)] if chain.order == 2 else [turn * own * (mean - w), 0 * w]
        return np.concatenate([change, np.concatenate(hidden).astype(complex).view(float)])

    u, v = chain.unpack(setting.start)
    hidden = np.concatenate([share @ u, 0 * (share @ u) if v is None else share @ v]).astype(complex).view(float)
    return chain.unpack(integrated(coupled, np.concatenate([setting.start, hidden]), setting.times)[:-unseen])


def _with_hidden(
    setting: Setting, push: Callable[[ndarray, ndarray], ndarray], change: Callable[[ndarray, ndarray], ndarray]
) -> Fields:
    """Return the readings with something unseen at each site, a number h that starts at 0.

    The push is given h and u; the rate at which h changes follows from h and v (u for order 1).
    """

    def both(_t: float, hidden: ndarray, u: ndarray, v: ndarray) -> tuple[ndarray, ndarray]:
        return push(hidden, u), change(hidden, v)

    return _with_unseen(setting, np.zeros(setting.chain.sites), both)


def _with_unseen(
    setting: Setting, begin: ndarray, both: Callable[[float, ndarray, ndarray, ndarray], tuple[ndarray, ndarray]]
) -> Fields:
    """Return the readings with unseen numbers h, real ones or complex ones as they are at the start.

    The push of the sites, and the rates at which these numbers change, follow from t, h, u and v (u for order 1).
    """
    chain = setting.chain
    rate, size, own = chain.right_hand_side, chain.parts * chain.sites, len(setting.start)

    def coupled(t: float, y: ndarray) -> ndarray:
        rates, (u, v) = rate(t, y[:own]), chain.unpack(y[:own])
        force, change = both(t, y[own:].view(begin.dtype), u, u if v is None else v)
        rates[-size:] += setting.parts(force)
        return np.concatenate([rates, change.view(float)])

    start = np.concatenate([setting.start, begin.view(float)])
    return chain.unpack(integrated(coupled, start, setting.times)[:own])


def _with_past(setting: Setting, late: Callable[[ndarray, ndarray], ndarray]) -> Fields:
    """Return the readings of a chain with a memory, integrated in steps of one delay: within one, the past is known.

    Before the start the field was what it was then.

    The push is given the field as it was and as it is.
    """
    from scipy.interpolate import CubicSpline

    chain, times, delay = setting.chain, setting.times, float(setting.drawn.about["delay"])
    rows: dict[float, ndarray] = {}
    first = chain.unpack(setting.start)[0]
    past: Callable[[float], ndarray] = lambda _: first  # noqa: E731
    y = setting.start
    for begin, end in itertools.pairwise(np.append(np.arange(times[0], times[-1], delay), times[-1])):
        grid = np.unique(np.concatenate([np.linspace(begin, end, 60), times[(times >= begin) & (times <= end)]]))

        def push(t: float, u: ndarray, _v: ndarray, past: Callable[[float], ndarray] = past) -> ndarray:
            return np.asarray(late(past(t - delay), u))

        u, v = replace(setting, start=y, times=grid).run(push)
        for k, t in enumerate(grid):
            rows[float(t)] = chain.pack(u[k], None if v is None else v[k])
        y = rows[float(grid[-1])]
        past = CubicSpline(grid, u)
    return chain.unpack(np.stack([rows[float(t)] for t in times], axis=1))
