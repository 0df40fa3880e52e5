"""What readings tell of effects: Fisher's information of all that is unknown in a chain and its sensors.

Sensitivities are differences between copies of the chain, which differ in one parameter each and are solved together
with the same steps, so that the errors of the integration cancel.

Where the ends of a short chain are unknown, what its outer sites did is unknown, too, but for their readings: each
follows a B-spline in time, whose coefficients are parameters like the others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.information import explained
from latticebench.bench.trials.laboratory.chains import Chain
from latticebench.bench.trials.laboratory.effects import Ingredient
from latticebench.bench.trials.laboratory.instruments import Instrument
from latticebench.bench.trials.laboratory.unread import Unread
from latticebench.methods.engine.bsplines import BSplines

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

# The last fifth of the readings must be at least this share of them all (RMS about the mean), and no swing larger than
# so many times the chain's size.
MOVING, BOUND = 0.12, 4.0
# B-splines of an outer site in each of its fastest waves, their degree, and the longest chain for which they are
# unknown: the two of a longer one at either end would be thousands.
PER_WAVE, DEGREE, SHORT = 6, 5, 8


@dataclass(frozen=True)
class Accuracy:
    """Relative tolerance of the integration, and the step of differences in the unit of each parameter."""

    tolerance: float
    step: float


ROUGH, FINE = Accuracy(1e-6, 1e-5), Accuracy(1e-10, 1e-6)


@dataclass(frozen=True, eq=False)
class Sight:
    """What readings tell of effects.

    Attributes:
        clean: readings without noise (T, N).
        rms: of these about their means.
        information: Fisher's, of all parameters, each in its own unit.
        parts: per effect, the places of its parameters in `information` and its direction in their units.
        amounts: of the effects.
        limits: their largest amounts.
    """

    clean: Float[ndarray, "time sites"]
    rms: float
    information: Float[ndarray, "parameters parameters"]
    parts: tuple[tuple[ndarray, ndarray], ...]
    amounts: Float[ndarray, " effects"]
    limits: Float[ndarray, " effects"]

    def whole(self, k: int) -> float:
        """Return the length of what an amount of 1 of an effect does to the readings, in units of the noise."""
        place, direction = self.parts[k]
        return float(np.sqrt(direction @ self.information[np.ix_(place, place)] @ direction))

    def left(self, k: int, beside: Sequence[int]) -> float:
        """Return what of that nothing else can do: neither the declared equation nor the effects `beside`."""
        return self._explained({k: 1.0}, beside)[0]

    def instead(self, gone: Sequence[int], beside: Sequence[int], other: int) -> tuple[float, float]:
        """Return what effects leave where another one is in their place, and how much of that one it takes.

        Args:
            gone: the effects, with their amounts.
            beside: the effects that are there.
            other: the one that takes their place.

        Returns:
            the first in units of the noise, the second as an amount.
        """
        left, does = self._explained({k: float(self.amounts[k]) for k in gone}, [*beside, other])
        place, direction = self.parts[other]
        return left, float(np.linalg.norm([does[int(p)] for p in place]) / np.linalg.norm(direction))

    def _explained(self, gone: Mapping[int, float], beside: Sequence[int]) -> tuple[float, dict[int, float]]:
        """Return what of effects nothing else can do, and how much of each other parameter does the rest.

        Args:
            gone: amounts of the effects.
            beside: the effects that are there; those of `gone` are not.
        """
        change = np.zeros(len(self.information))
        for k, amount in gone.items():
            place, direction = self.parts[k]
            change[place] += amount * direction
        of_effects = {int(p) for places, _ in self.parts for p in places}
        there = {int(p) for j in beside if j not in gone for p in self.parts[j][0]}
        others = np.array([p for p in range(len(self.information)) if p not in of_effects or p in there])
        left, does = explained(self.information, change, others)
        return left, dict(zip(others.tolist(), does.tolist(), strict=True))

    def apart(self, k: int, beside: Sequence[int]) -> float:
        """Return the share of an effect that nothing else can do."""
        return self.left(k, beside) / max(self.whole(k), 1e-300)

    def size(self, k: int, beside: Sequence[int]) -> float:
        """Return the size z of an effect."""
        return float(self.amounts[k]) * self.left(k, beside)

    @property
    def moves(self) -> bool:
        """Whether the motion goes on to the end."""
        about = self.clean - self.clean.mean(axis=0)
        last = about[-len(about) // 5 :]
        last = last - last.mean(axis=0)
        return bool(np.sqrt(np.mean(last**2)) > MOVING * np.sqrt(np.mean(about**2)))


@dataclass(frozen=True, eq=False)
class Experiment:
    """A chain in front of an instrument.

    Attributes:
        chain: what moves.
        instrument: what reads.
        times: when it does.
        gone: readings that are missing.
        reach: sites at either end that are only read, where the ends are unknown; without noise if there are more than
            `SHORT` sites.
    """

    chain: Chain
    instrument: Instrument
    times: Float[ndarray, " time"]
    gone: Bool[ndarray, "time sites"]
    reach: int

    def look(
        self,
        effects: Sequence[Ingredient],
        amounts: ndarray,
        accuracy: Accuracy,
        border: Float[ndarray, "time sites splines"] | None = None,
    ) -> Sight | None:
        """Return what is seen of effects of these amounts; None where the motion is unbounded.

        Args:
            effects: that are looked at.
            amounts: of them.
            accuracy: of the integration.
            border: what the splines of the outer sites do to the readings; nothing if None, as where there are none.
        """
        table = self._declared()
        parts = []
        for one, amount in zip(effects, amounts, strict=True):
            values = one.values(amount)
            rows = {name: table.add(one.key(name), values[name], one.unit(name)) for name in values}
            # The frequency of a drive belongs to it, but is no part of its size.
            place = np.array([rows[name] for name in one.direction])
            parts.append((place, np.array([value / one.unit(name) for name, value in one.direction.items()])))
        readings = self._readings(table.copies(accuracy.step), accuracy.tolerance)
        if readings is None:
            return None
        clean = readings[0]
        rms = float(np.sqrt(np.mean(np.var(clean, axis=0))))
        columns = np.moveaxis((readings[1:] - clean) / accuracy.step, 0, -1)
        if border is not None:
            columns = np.concatenate([columns, border], axis=2)
        weighed = self.instrument.whitened(columns, clean, rms) * ~self.gone.reshape(-1, 1)
        limits = np.array([one.most for one in effects])
        return Sight(clean, rms, weighed.T @ weighed, tuple(parts), np.asarray(amounts), limits)

    def border(self, effects: Sequence[Ingredient], amounts: ndarray) -> Float[ndarray, "time sites splines"] | None:
        """Return what the splines of the outer sites do to the readings, with effects of these amounts.

        None where there are none, or where the motion is unbounded.
        """
        if self._border is None:
            return None
        table = self._declared(free=False)
        for one, amount in zip(effects, amounts, strict=True):
            for name, value in one.values(amount).items():
                table.add(one.key(name), value, one.unit(name), free=False)
        for k in self._outer:
            for j in range(self._border.count):
                table.add(f"border.{k}.{j}", 0.0, self.chain.size)
        readings = self._readings(table.copies(ROUGH.step), ROUGH.tolerance)
        return None if readings is None else np.moveaxis((readings[1:] - readings[0]) / ROUGH.step, 0, -1)

    def _declared(self, *, free: bool = True) -> _Table:
        """Return the start and the declared coefficients."""
        chain, table = self.chain, _Table()
        for level, unit in enumerate((chain.size, chain.size * chain.fast)):
            for k in range(chain.sites):
                inner = self.reach <= k < chain.sites - self.reach
                table.add(f"start.{level}.{k}", chain.start[level, k], unit, free=free and inner)
        for text, value in zip(chain.declared, chain.coefficients, strict=True):
            table.add(text, value, abs(value), free=free)
        return table

    @property
    def _outer(self) -> list[int]:
        return [k for k in range(self.chain.sites) if not self.reach <= k < self.chain.sites - self.reach]

    @functools.cached_property
    def _border(self) -> BSplines | None:
        """The B-splines that what an outer site did is made of; None where nothing is unknown of it."""
        if not self.reach or self.chain.sites > SHORT:
            return None
        end = float(self.times[-1])
        intervals = max(1, round(PER_WAVE * self.chain.fast * end / (2 * np.pi)))
        return BSplines.clamped(np.linspace(0.0, end, intervals + 1), DEGREE)

    def _readings(self, of: Mapping[str, ndarray], tolerance: float) -> Float[ndarray, "copies time sites"] | None:
        """Return the readings of copies of the chain with these parameters; None where one is unbounded."""
        from scipy.integrate import solve_ivp

        chain, sites = self.chain, self.chain.sites
        start = np.stack([np.concatenate([of[f"start.{level}.{k}"] for k in range(sites)], axis=1) for level in (0, 1)])
        outer, beyond = self._outer, _Beyond.of(of, self._outer, self._border)
        sensors, unread = _Sensors(of, sites, float(self.times[-1])), Unread.of(of)
        if unread.sites:
            start = np.concatenate([start, unread.start()], axis=2)
        known = ("start.", "border.")
        moving = {name: value for name, value in of.items() if not name.startswith(known) and np.any(value != 0)}

        def held(t: float, u: ndarray) -> ndarray:
            return beyond.moved(t, sensors.held(u, outer))

        def rate(t: float, y: ndarray) -> ndarray:
            u, v = y.reshape(start.shape)
            force = chain.rate(t, held(t, u[:, :sites]), v[:, :sites], moving)
            return np.concatenate([v.ravel(), unread.pushed(force, u, v).ravel()])

        def lost(_t: float, y: ndarray) -> float:
            return BOUND * chain.size - float(np.max(np.abs(y[:sites])))

        lost.terminal = True  # type: ignore[attr-defined]
        small = np.repeat([chain.size, chain.size * chain.fast], start[0].size) * tolerance * 0.1
        with np.errstate(all="ignore"):
            found = solve_ivp(
                rate, (0.0, float(self.times[-1] + np.max(sensors.lost))), start.ravel(), t_eval=self.times,
                method="DOP853", rtol=tolerance, atol=small, events=lost, dense_output=sensors.read_elsewhen,
            )  # fmt: skip
            if found.status != 0 or not np.all(np.isfinite(found.y)):
                return None
            behind = np.zeros((len(self.times), 1, 1))
            if found.sol is not None:
                # What a sensor shows first was before the start.
                earliest = -max(float(np.max(sensors.lag)), 0.0)
                back = solve_ivp(
                    rate, (0.0, earliest), start.ravel(), method="DOP853", rtol=tolerance, atol=small,
                    dense_output=True,
                )  # fmt: skip
                behind = sensors.behind(
                    self.times,
                    lambda t: np.where(t < 0, back.sol(np.minimum(t, 0.0)), found.sol(t)).reshape(*start.shape, -1),
                )
        u = np.moveaxis(found.y.reshape(*start.shape, -1), -1, 1)[0, :, :, :sites]
        rows = zip(self.times, u, behind, strict=True)
        return np.moveaxis(np.stack([sensors.read(float(t), held(float(t), row) + by) for t, row, by in rows]), 0, 1)


class _Table:
    """Parameters with their values and units, and copies in each of which one of them is a little different."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.places: dict[str, int] = {}
        self.units: list[float] = []

    def add(self, name: str, value: float, unit: float, *, free: bool = True) -> int:
        """Add a parameter and return its place among the free ones; one that is there is kept."""
        if name in self.values:
            return self.places[name]
        self.values[name] = float(value)
        if free:
            self.places[name] = len(self.units)
            self.units.append(unit)
        return len(self.units) - 1

    def copies(self, step: float) -> dict[str, ndarray]:
        """Return the value of each parameter in each copy (copies, 1); the first copy has them as they are."""
        found = {name: np.full((len(self.units) + 1, 1), value) for name, value in self.values.items()}
        for name, place in self.places.items():
            found[name][place + 1] += step * self.units[place]
        return found


@dataclass(frozen=True, eq=False)
class _Beyond:
    """By how much outer sites are elsewhere than their readings say, per copy.

    Attributes:
        outer: the sites.
        basis: B-splines in time, or None where they are where they are read.
        splines: coefficients of each site (site, copies, splines).
    """

    outer: Sequence[int]
    basis: BSplines | None
    splines: Float[ndarray, "site copies splines"]

    @classmethod
    def of(cls, parameters: Mapping[str, ndarray], outer: Sequence[int], basis: BSplines | None) -> _Beyond:
        if basis is None or not any(name.startswith("border.") for name in parameters):
            return cls(outer, None, np.zeros((0, 0, 0)))
        rows = [[parameters[f"border.{k}.{j}"] for j in range(basis.count)] for k in outer]
        return cls(outer, basis, np.stack([np.concatenate(one, axis=1) for one in rows]))

    def moved(self, t: float, u: Float[ndarray, "copies sites"]) -> ndarray:
        if self.basis is None:
            return u
        (first,), (curve,), _ = self.basis.basis(np.array([t]))
        found = u.copy()
        for site, splines in zip(self.outer, self.splines, strict=True):
            found[:, site] += splines[:, first : first + len(curve)] @ curve
        return found


class _Sensors:
    """What the sensors make of positions, per copy."""

    def __init__(self, of: Mapping[str, ndarray], sites: int, span: float) -> None:
        zero = np.zeros((len(next(iter(of.values()))), 1))

        def row(name: str) -> ndarray:
            return np.concatenate([of.get(f"{name}_{k + 1}", zero) for k in range(sites)], axis=1)

        self.offset, self.gain = row("offset"), 1 + row("gain")
        self.curve, self.lag = of.get("curve", zero) + row("curve"), row("lag")
        self.cubic, self.crosstalk = of.get("cubic", zero), of.get("crosstalk", zero)
        self.fade, self.slow, self.span = row("fade"), row("slow"), span
        self.lost, self.when = (of.get(f"frames.{name}", zero) for name in ("lost", "when"))

        def each(kind: str, *names: str) -> dict[int, list[ndarray]]:
            """Return these numbers of each sensor that has them."""
            first = f"{kind}.{names[0]}@"
            those = [name.removeprefix(first) for name in of if name.startswith(first)]
            return {int(k): [of[f"{kind}.{name}@{k}"] for name in names] for k in those}

        self.jumps, self.changes = each("jump", "jump", "when"), each("change", "change", "when")
        self.hums, self.cycles = each("hum", "cos", "sin", "omega"), each("cycle", "sine", "cosine", "per_reading")

    @property
    def read_elsewhen(self) -> bool:
        """Whether readings are of other times than they say."""
        return any(np.any(late) for late in (self.lag, self.slow, self.lost))

    def behind(self, times: ndarray, motion: Callable[[ndarray], ndarray]) -> Float[ndarray, "time copies sites"]:
        """Return by how much positions were more when they were read.

        Args:
            times: of the readings.
            motion: u and v at given times (2, copies, sites, T).
        """
        now, found = np.moveaxis(motion(times)[0], -1, 0), np.zeros((len(times), *self.lag.shape))
        lost = np.where(times[:, None] > self.when[:, 0], self.lost[:, 0], 0.0)
        for site in np.flatnonzero(np.any(self.lag, axis=0) | np.any(self.slow, axis=0) | np.any(self.lost)):
            late = self.lag[:, site] + times[:, None] * self.slow[:, site] - lost
            u, v = np.moveaxis(motion(times - late[:, 0])[:, :, site], -1, 1)
            # In a copy that is late by another time, to first order in that.
            found[..., site] = u - (late - late[:, :1]) * v - now[..., site]
        return found

    def read(self, t: float, u: Float[ndarray, "copies sites"]) -> ndarray:
        """Return the readings of positions as they were when they were read."""
        found = np.asarray((self.gain + self.fade * t / self.span) * u + self.offset + self.curve * u**2)
        found += self.cubic * u**3
        found[:, 1:] += self.crosstalk * u[:, :-1]
        found[:, :-1] += self.crosstalk * u[:, 1:]
        for site, (cos, sin, omega) in self.hums.items():
            found[:, site] += (cos * np.cos(omega * t) + sin * np.sin(omega * t))[:, 0]
        for site, (jump, when) in self.jumps.items():
            found[:, site] += np.where(t > when, jump, 0.0)[:, 0]
        for site, (change, when) in self.changes.items():
            found[:, site] += np.where(t > when, change, 0.0)[:, 0] * u[:, site]
        for site, (sine, cosine, per_reading) in self.cycles.items():
            angle = per_reading[:, 0] * u[:, site]
            found[:, site] += sine[:, 0] * np.sin(angle) + cosine[:, 0] * (np.cos(angle) - 1)
        return found

    def held(self, u: Float[ndarray, "copies sites"], outer: Sequence[int]) -> ndarray:
        """Return positions with the outer ones such that every copy has the readings of the first there.

        Outer sensors neither hum, lag, jump, fade, repeat an error nor hear others.
        """
        if not outer:
            return u
        first = u[0]
        wrong = (self.gain - self.gain[0]) * first + self.offset - self.offset[0]
        wrong = wrong + (self.curve - self.curve[0]) * first**2 + (self.cubic - self.cubic[0]) * first**3
        steepness = self.gain[0] + 2 * self.curve[0] * first + 3 * self.cubic[0] * first**2
        found = u.copy()
        found[:, outer] = (first - wrong / steepness)[:, outer]
        return found
