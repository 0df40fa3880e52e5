"""What is put into a chain or its sensors: which effects make sense there, how large they may be, and their parameters.

Parameters are named "coefficient" (of the catalogue's formula), "scale" (of a site's whole right-hand side beyond 1),
"cos", "sin" and "omega" (of a drive, at all sites or at one, or of a sensor's hum), "offset_2", "gain_2", "curve_2",
"lag_2" and "jump_2" (of the second sensor, which reads gain * u + offset + curve * u^2 of a time lag ago, and from the
time "when" on jump more), "change_2" (what its gain has more from "when" on), "fade_2" (by how much its gain grows over
the recording), "slow_2" (how much later it reads per time), "sine_2", "cosine_2" and "per_reading" (of an error
a sin(k u) + b (cos(k u) - 1) of it), "lost" (how much later all are read from "when" on), "crosstalk" (how much of its
neighbours each sensor reads), "curve" and "cubic" (one for all, the latter of u^3), "bond_2" (from the second site on),
"ramp of u[n]" (how fast that coefficient changes) and "step of u[n]" (by how much it does, at "when"), and those of
`unread.NUMBERS`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.laboratory.chains import Chain
from latticebench.bench.trials.laboratory.unread import NUMBERS, SIDE, SUPPORT

if TYPE_CHECKING:
    from numpy import ndarray

OFFSET, GAIN, CURVE, DRIVE, MASSES = "sensor-offset", "sensor-gain", "sensor-curve", "drive", "unequal-masses"
TAKING = ("damping", "quadratic-drag", "dry-friction")
AT_ONE_SITE = ("defect", MASSES)
# At one site or bond, too; put in where they are asked for.
LOCAL_DRIVE, LOCAL_DAMPING, BOND = "local-drive", "local-damping", "bond-defect"
LOCAL = (LOCAL_DRIVE, LOCAL_DAMPING, BOND)
# A bearing that grates, a mass that hangs at one site, and a support that all hang on, likewise.
RUB, SIDE_MASS, SWAYING = "local-friction", "side-mass", "swaying-support"
# A curve that one sensor has alone; put in where it is asked for.
OWN_CURVE = "own-sensor-curve"
# A sensor that hums, likewise; as fast as to be read so many times in half a period at least.
HUM, PER_HALF = "sensor-hum", 1.25
# A sensor that lags, one that is knocked, and all that see through a lens, likewise.
LAG, JUMP, LENS = "sensor-lag", "sensor-jump", "sensor-saturation"
# Sensors that hear their neighbours, one whose gain drifts, and one with a clock of its own, likewise.
CROSSTALK, FADING, OWN_CLOCK = "sensor-crosstalk", "sensor-gain-drift", "sensor-clock"
# A sensor that changes its range, an encoder out of centre, and a camera that drops frames, likewise.
RANGE, CYCLIC, DROPPED = "sensor-gain-jump", "sensor-cyclic", "clock-jump"
# Declared coefficients that change, likewise.
AGEING, SLIP = "coefficient-drift", "coefficient-jump"
# Springs of which no two are alike, likewise.
BONDS, FEWEST_BONDS = "unequal-bonds", 3
# A hum that is at least so many times as fast as the chain, where it is read so often; put in where it is asked for.
MAINS, FASTER = "mains", 6.0
# Of Fermi, Pasta and Ulam, and of van der Pol; put in where they are asked for.
LOSS = "nonlinear-damping"
CLASSIC = ("quadratic-coupling", LOSS)
COUPLED = ("quadratic-coupling", "nonlinear-coupling", "asymmetric-coupling")
MOST_EFFECTS = 5
# What has a meaning where there are several sites that move.
OF_SEVERAL = (
    GAIN, *AT_ONE_SITE, LOCAL_DRIVE, LOCAL_DAMPING, OWN_CURVE, HUM, LAG, JUMP, MAINS, CROSSTALK, FADING, OWN_CLOCK,
    RUB, SWAYING, RANGE, CYCLIC,
)  # fmt: skip
# What is put in only where all sites have an equation.
OF_KNOWN_ENDS = (CROSSTALK, SWAYING, DROPPED)
# What is asked for instead of names.
ANY, NONE = "any", "none"
DECLARED = {"onsite-linear": "u[n]", "onsite-cubic": "u[n]**3"}
NAMES = (
    OFFSET, GAIN, CURVE, *TAKING, "onsite-linear", "onsite-quadratic", "onsite-cubic", "onsite-quintic", *AT_ONE_SITE,
    "nonlinear-coupling", "asymmetric-coupling", "next-neighbour", DRIVE, "constant-force",
)  # fmt: skip
# How often each is drawn, where 1 is not given: what most recordings have.
OFTEN = {OFFSET: 3.0, GAIN: 2.0, "damping": 3.0, "quadratic-drag": 1.5, "dry-friction": 1.5, "defect": 1.5}
ASKED = (*NAMES, *LOCAL, BONDS, OWN_CURVE, HUM, LAG, JUMP, LENS, MAINS, CROSSTALK, FADING, OWN_CLOCK,
         RUB, SIDE_MASS, SWAYING, RANGE, CYCLIC, DROPPED, AGEING, SLIP, *CLASSIC)  # fmt: skip
"""Every effect that can be asked for."""
HELD_OUT = (frozenset({GAIN, "dry-friction"}), frozenset({"defect", "onsite-quintic", "damping"}))
"""Combinations of effects that are never drawn, alone or with others, unless they are asked for."""


@dataclass(frozen=True, eq=False)
class Ingredient:
    """An effect with the direction of its parameters; their true values are `amount` times that.

    Attributes:
        name: of the catalogue.
        site: where it acts, or None.
        direction: its parameters at an amount of 1.
        most: the largest amount.
        fixed: further parameters, whatever the amount: the frequency of a drive.
        strong: an amount that it has whatever its size; 0 for one that is chosen by its size.
    """

    name: str
    site: int | None
    direction: Mapping[str, float]
    most: float
    fixed: Mapping[str, float]
    strong: float = 0.0

    @property
    def tangent(self) -> float:
        """The largest amount for which what the tangent promises of it can be believed.

        A factor must not come near 0: on the tangent, a site without mass is a site without any other effect.
        """
        return 0.9 if self.name in (GAIN, MASSES) else 10 * self.most

    def key(self, parameter: str) -> str:
        """Return the name of one of its parameters among all of a chain's, see `Chain.rate`."""
        own = {HUM: "hum", JUMP: "jump", RANGE: "change", CYCLIC: "cycle", SIDE_MASS: SIDE}.get(self.name)
        if own is not None:
            return f"{own}.{re.sub('_[0-9]+$', '', parameter)}@{self.site}"
        if self.name in (SWAYING, DROPPED):
            return f"{SUPPORT if self.name == SWAYING else 'frames'}.{parameter}"
        if self.name in (AGEING, SLIP):
            return parameter if parameter in self.direction else "step when"
        if self.name == BONDS:
            return f"{BOND}@{int(parameter.partition('_')[2]) - 1}"
        if self.name in (DRIVE, LOCAL_DRIVE):
            return f"drive.{parameter}" + ("" if self.site is None else f"@{self.site}")
        if self.name == "disorder":
            return f"defect@{int(parameter.partition('_')[2]) - 1}"
        if self.name in (*AT_ONE_SITE, LOCAL_DAMPING, RUB, BOND):
            return f"{self.name}@{self.site}"
        return self.name if parameter == "coefficient" else parameter

    def unit(self, parameter: str) -> float:
        """Return the unit of a parameter: the root mean square of all at an amount of 1."""
        if parameter in self.fixed:
            return 0.01 * abs(self.fixed[parameter])
        return float(np.sqrt(np.mean(np.square(list(self.direction.values())))))

    def values(self, amount: float) -> dict[str, float]:
        """Return its parameters; a gain as what it is beyond 1."""
        return {**{name: amount * value for name, value in self.direction.items()}, **self.fixed}

    def truth(self, amount: float) -> dict[str, float]:
        """Return its parameters as they are said: a gain as the factor."""
        return {name: value + name.startswith("gain") for name, value in self.values(amount).items()}


def sensible(chain: Chain, reach: int, names: Sequence[str] = NAMES) -> list[str]:
    """Return the effects that have a meaning in a chain.

    Args:
        chain: which.
        reach: sites at either end that are only read; more than 0 where the ends are unknown.
        names: of the effects that may be.
    """
    inner = chain.sites - 2 * reach
    found = []
    for name in names:
        if DECLARED.get(name) in chain.declared:
            continue
        if name in OF_SEVERAL and inner < 2:
            continue
        if name in OF_KNOWN_ENDS and reach:
            continue
        if name == BOND and not (chain.coupled and inner > 2):
            continue
        if name == BONDS and not (chain.coupled and not reach and inner > FEWEST_BONDS):
            continue
        if name in COUPLED and not (chain.coupled and chain.sites >= 2):
            continue
        if name == "next-neighbour" and (not chain.coupled or inner < 4 or reach == 1):
            continue
        found.append(name)
    return found


def draw_ingredient(name: str, chain: Chain, reach: int, draw: np.random.Generator) -> Ingredient:
    """Return an effect at a place and with a direction.

    Args:
        name: of the effect.
        chain: what it is put into.
        reach: sites at either end that are only read.
        draw: for place, sign and direction.
    """
    inner = np.arange(reach, chain.sites - reach)
    site = int(draw.choice(inner[:-1] if name == BOND else inner))
    sign = -1.0 if name in (*TAKING, LOCAL_DAMPING, RUB, LOSS) else float(draw.choice([-1.0, 1.0]))
    if name == OFFSET:
        return _offset(chain, inner, draw)
    if name == GAIN:
        return _gain(chain, inner, draw)
    if name in (JUMP, RANGE, DROPPED):
        when = {"when": float(chain.span * draw.uniform(0.15, 0.85))}
        return {
            JUMP: Ingredient(name, site, {f"jump_{site + 1}": sign * chain.size}, 1.0, when),
            RANGE: Ingredient(name, site, {f"change_{site + 1}": sign}, 0.4, when),
            DROPPED: Ingredient(name, None, {"lost": 1 / chain.fast}, 2.0, when),
        }[name]
    if name == CYCLIC:
        return _cyclic(chain, site, draw)
    if name in (SIDE_MASS, SWAYING):
        return _swinging(name, chain, site, draw)
    if name in (AGEING, SLIP):
        return _changing(name, chain, sign, draw)
    if name == BONDS:
        each = chain.coupling * draw.normal(size=chain.sites - 1)
        each -= np.mean(each)
        return Ingredient(name, None, {f"bond_{k + 1}": float(value) for k, value in enumerate(each)}, 0.3, {})
    if name in (HUM, MAINS):
        phase = draw.uniform(0, 2 * np.pi)
        read = np.pi / PER_HALF * (chain.readings - 1) / chain.span
        lowest, highest = 0.3 * chain.slow, min(4 * chain.fast, read)
        if name == MAINS:
            lowest, highest = min(FASTER * chain.fast, read / 2), read
        omega = np.exp(draw.uniform(np.log(lowest), np.log(highest)))
        waves = {"cos": chain.size * np.cos(phase), "sin": chain.size * np.sin(phase)}
        return Ingredient(HUM, site, waves, 0.5, {"omega": float(omega)})
    if name in (DRIVE, LOCAL_DRIVE):
        phase = draw.uniform(0, 2 * np.pi)
        force = chain.slow**2 * chain.size
        omega = np.exp(draw.uniform(np.log(0.3 * chain.slow), np.log(1.3 * chain.fast)))
        waves = {"cos": force * np.cos(phase), "sin": force * np.sin(phase)}
        return Ingredient(name, site if name == LOCAL_DRIVE else None, waves, 0.5, {"omega": float(omega)})
    return ingredient(name, chain, site, sign)


def ingredient(name: str, chain: Chain, site: int, sign: float = 1.0) -> Ingredient:
    """Return an effect with one parameter; the site counts where it acts at one."""
    if name == CURVE:
        return Ingredient(name, None, {"curve": sign / chain.size}, 0.15, {})
    if name == OWN_CURVE:
        return Ingredient(CURVE, site, {f"curve_{site + 1}": sign / chain.size}, 0.15, {})
    if name == LENS:
        return Ingredient(name, None, {"cubic": sign / chain.size**2}, 0.2, {})
    if name == LAG:
        return Ingredient(name, site, {f"lag_{site + 1}": 1 / chain.fast}, 0.3, {})
    if name == CROSSTALK:
        return Ingredient(name, None, {"crosstalk": sign}, 0.15, {})
    if name == FADING:
        return Ingredient(name, site, {f"fade_{site + 1}": sign}, 0.4, {})
    if name == OWN_CLOCK:
        return Ingredient(name, site, {f"slow_{site + 1}": 1 / chain.fast / chain.span}, 0.5, {})
    if name == GAIN:
        return Ingredient(name, site, {f"gain_{site + 1}": sign}, 0.4, {})
    if name == MASSES:
        return Ingredient(name, site, {"scale": sign}, 0.9 if sign > 0 else 0.45, {})
    unit, most = _unit(name, chain)
    placed = name in ("defect", LOCAL_DAMPING, RUB, BOND)
    return Ingredient(name, site if placed else None, {"coefficient": sign * unit}, most, {})


def candidates(chain: Chain, reach: int) -> list[Ingredient]:
    """Return what might be there instead of an effect: each effect at each place, and three that are never put in."""
    inner = range(reach, chain.sites - reach)
    found = [Ingredient(OFFSET, None, {f"offset_{k + 1}": chain.size for k in range(chain.sites)}, 1.0, {})]
    for name in sensible(chain, reach, (*NAMES, LOCAL_DAMPING, BOND)):
        if name not in (OFFSET, DRIVE):
            places = inner if name in (GAIN, *AT_ONE_SITE, LOCAL_DAMPING) else inner[:-1] if name == BOND else inner[:1]
            found += [ingredient(name, chain, site) for site in places]
    if len(inner) > 1:
        found += [ingredient("gradient", chain, 0), ingredient("trap", chain, 0)]
        found.append(Ingredient("disorder", None, {f"site_{k + 1}": chain.slow**2 for k in inner}, 1.0, {}))
    return found


def _unit(name: str, chain: Chain) -> tuple[float, float]:
    """Return a coefficient that changes the motion by about as much as itself, and how many of it there may be."""
    slow, size, span, coupling = chain.slow, chain.size, chain.span, chain.coupling
    return {
        "damping": (1 / span, 4.0),
        "local-damping": (1 / span, 6.0),
        "local-friction": (size * slow / span, 1.2),
        "bond-defect": (coupling, 0.5),
        "quadratic-drag": (1 / (slow * size * span), 5.0),
        "dry-friction": (size * slow / span, 0.8),
        "nonlinear-damping": (1 / (size**2 * span), 8.0),
        "onsite-linear": (slow**2, 0.4),
        "onsite-quadratic": (slow**2 / size, 0.25),
        "onsite-cubic": (slow**2 / size**2, 0.4),
        "onsite-quintic": (slow**2 / size**4, 0.4),
        "constant-force": (slow**2 * size, 0.3),
        "gradient": (slow**2 * size, 0.3),
        "trap": (slow**2, 0.3),
        "defect": (slow**2, 0.4),
        "next-neighbour": (coupling, 0.15),
        "quadratic-coupling": (coupling / size, 0.2),
        "nonlinear-coupling": (coupling / size**2, 0.3),
        "asymmetric-coupling": (coupling, 0.2),
    }[name]


def _changing(name: str, chain: Chain, sign: float, draw: np.random.Generator) -> Ingredient:
    """Return a declared coefficient of a force that is linear in small swings, which changes steadily or at once."""
    linear = [k for k, text in enumerate(chain.declared) if text != DECLARED["onsite-cubic"]]
    k = int(draw.choice(linear))
    text, value = chain.declared[k], sign * float(chain.coefficients[k])
    if name == AGEING:
        return Ingredient(name, None, {f"ramp of {text}": value / chain.span}, 0.2, {})
    when = chain.span * draw.uniform(0.15, 0.85)
    return Ingredient(name, None, {f"step of {text}": value}, 0.2, {"when": float(when)})


def _cyclic(chain: Chain, site: int, draw: np.random.Generator) -> Ingredient:
    """Return an error of one sensor that repeats 0.4 to 3 times from zero to the largest swing."""
    per_reading = 2 * np.pi / chain.size * np.exp(draw.uniform(np.log(0.4), np.log(3.0)))
    phase = draw.uniform(0, 2 * np.pi)
    size = 1 / float(per_reading)
    waves = {f"sine_{site + 1}": size * np.cos(phase), f"cosine_{site + 1}": size * np.sin(phase)}
    return Ingredient(CYCLIC, site, waves, 0.5, {"per_reading": float(per_reading)})


def _swinging(name: str, chain: Chain, site: int, draw: np.random.Generator) -> Ingredient:
    """Return a mass at one site, or the support of all; at first it is nearly where it hangs, and nearly at rest."""
    omega = np.exp(draw.uniform(np.log(0.5 * chain.slow), np.log(1.4 * chain.fast)))
    gamma = omega * np.exp(draw.uniform(np.log(0.003), np.log(0.1)))
    y, rate = 0.03 * chain.size * draw.normal(size=2) * [1.0, omega]
    if name == SWAYING:
        return Ingredient(name, None, {"mass": 1.0}, 0.5 / chain.sites, _unread(omega, gamma, y, rate))
    y, rate = chain.start[:, site] + [y, rate]
    return Ingredient(name, site, {"mass": 1.0}, 0.3, _unread(omega, gamma, y, rate))


def _unread(*numbers: float) -> dict[str, float]:
    return dict(zip(NUMBERS[1:], map(float, numbers), strict=True))


def _offset(chain: Chain, inner: ndarray, draw: np.random.Generator) -> Ingredient:
    """Return an offset of every sensor, or of one."""
    if draw.uniform() < 0.7:
        each = {f"offset_{k + 1}": chain.size * draw.normal() for k in range(chain.sites)}
        site = None
    else:
        site = int(draw.choice(inner))
        each = {f"offset_{site + 1}": chain.size * float(draw.choice([-1.0, 1.0]))}
    strong = float(np.exp(draw.uniform(np.log(0.05), np.log(1.0)))) if draw.uniform() < 0.4 else 0.0
    return Ingredient(OFFSET, site, each, 2.0, {}, strong)


def _gain(chain: Chain, inner: ndarray, draw: np.random.Generator) -> Ingredient:
    """Return a scale of one sensor, or now and then of several, that is a few per cent off or another one."""
    site = int(draw.choice(inner))
    sign = float(draw.choice([-1.0, 1.0]))
    if draw.uniform() < 0.4:
        factor = draw.uniform(1.15, 1.8) if sign > 0 else draw.uniform(0.6, 0.85)
        return Ingredient(GAIN, site, {f"gain_{site + 1}": sign}, 0.8, {}, abs(factor - 1))
    if len(inner) > 2 and draw.uniform() < 0.3:
        # Not of all: one scale is that of the motion.
        several = {f"gain_{k + 1}": float(draw.normal()) for k in inner[:-1]}
        return Ingredient(GAIN, None, several, 0.2, {})
    return ingredient(GAIN, chain, site, sign)


def is_held_out(names: set[str]) -> bool:
    """Return whether a combination of effects holds one of `HELD_OUT`."""
    return any(one <= names for one in HELD_OUT)
