"""Chains as laboratories have them: a declared equation with its true coefficients, and a start.

A chain is drawn in laboratory units: its fastest mode has 0.3 to 20 Hz, its swings are a fraction of a radian or
hundreds of pixels. `Chain.rate` is its motion with any effect in it, evaluated on many copies of the chain at once,
each with parameters of its own; differences between the copies are the sensitivities that sizes are computed from.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.stencil import Ends, ghosts

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

Parameters = Mapping[str, "Float[ndarray, 'copies one']"]

COUPLING = "u[n+1]+u[n-1]-2*u[n]"
# Units of readings with the range of their largest swing.
UNITS = {
    "deg": (3.0, 60.0), "px": (20.0, 400.0), "cm": (0.5, 20.0), "mm": (2.0, 150.0), "m": (0.01, 0.3), "V": (0.1, 5.0),
}  # fmt: skip
RADIANS = (0.15, 1.6)
SLOWEST, FASTEST = 0.3, 20.0
# Periods of the fastest mode in a record, and periods of the slowest mode that it has at least.
FEWEST_PERIODS, MOST_PERIODS, SLOW_PERIODS = 10.0, 80.0, 3.0
RINGS = 0.2
FEWEST_READINGS, MOST_READINGS, PER_PERIOD = 500, 5000, 8.0
# Dry friction is -mu tanh(v / w) with w this share of the largest speed: a layer so thin that the energy taken in a
# period is that of -mu sign(v) to about one in a thousand.
LAYER = 0.01

# A coefficient that changes at once does so along a tanh of this width, over the fastest mode's angular frequency.
SUDDEN = 0.1

EQUATIONS: tuple[tuple[tuple[str, ...], tuple[Ends, ...], int], ...] = (
    ((COUPLING, "u[n]"), ("free", "fixed", "periodic"), 2),
    ((COUPLING, "sin(u[n])"), ("free", "fixed", "periodic"), 2),
    ((COUPLING,), ("fixed",), 2),
    ((COUPLING, "u[n]", "u[n]**3"), ("free", "fixed"), 2),
    (("u[n]",), ("free",), 1),
    (("sin(u[n])",), ("free",), 1),
    (("u[n]", "u[n]**3"), ("free",), 1),
)
"""Declared equations with the ends that they make sense with and the fewest sites; the last three are one site's."""


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain, its start, and when it is read.

    Attributes:
        declared: terms of the declared equation.
        coefficients: of these, true ones.
        sites: N.
        ends: how the chain really ends.
        unit: of the readings.
        size: largest swing of the chain without effects, about.
        start: positions and velocities at the first time (2, N).
        slow, fast: angular frequencies of the slowest and the fastest mode of small swings.
        span: time from the first reading to the last.
        readings: number of sample times.
    """

    declared: tuple[str, ...]
    coefficients: Float[ndarray, " terms"]
    sites: int
    ends: Ends
    unit: str
    size: float
    start: Float[ndarray, "two sites"]
    slow: float
    fast: float
    span: float
    readings: int

    @property
    def coupled(self) -> bool:
        """Whether neighbours are coupled."""
        return COUPLING in self.declared

    @property
    def coupling(self) -> float:
        """The coefficient of the coupling; 0 where there is none."""
        return float(self.coefficients[self.declared.index(COUPLING)]) if self.coupled else 0.0

    @property
    def stiffness(self) -> float:
        """The square of the frequency of a site whose neighbours stand still (1/s^2)."""
        own = sum(-value for text, value in zip(self.declared, self.coefficients, strict=True) if text in LINEAR)
        return float(own + 2 * self.coupling)

    @functools.cached_property
    def shifts(self) -> Mapping[int, Float[ndarray, "sites sites"]]:
        """Matrices that give u[n+k], with what the ends repeat."""
        return shifts(self.sites, self.ends)

    @functools.cached_property
    def frictions(self) -> Mapping[str, Callable[[ndarray, ndarray], ndarray]]:
        """Each force that follows the velocity, as a function of u and v (copies, N), by the name of its effect."""
        thin = self.size * self.fast * LAYER
        return {
            "damping": lambda _, v: v,
            "quadratic-drag": lambda _, v: np.abs(v) * v,
            "dry-friction": lambda _, v: np.tanh(v / thin),
            "nonlinear-damping": lambda u, v: u**2 * v,
            **{
                f"local-damping@{k}": lambda _, v, row=row: v * row  # type: ignore[misc]
                for k, row in enumerate(np.eye(self.sites))
            },
            **{
                f"local-friction@{k}": lambda _, v, row=row: np.tanh(v / thin) * row  # type: ignore[misc]
                for k, row in enumerate(np.eye(self.sites))
            },
        }

    @functools.cached_property
    def forces(self) -> Mapping[str, Callable[[ndarray], ndarray]]:
        """Each other force as a function of u (copies, N): declared terms by their texts, others by their effects.

        Those at one site (0, ..., N-1) are called "defect@0" and so on, that at the bond from it to the next
        "bond-defect@0".
        """
        eye = self.shifts[0]
        near = self.shifts[1] + self.shifts[-1] - 2 * eye
        far = self.shifts.get(2, 0 * eye) + self.shifts.get(-2, 0 * eye) - 2 * eye
        skew = (self.shifts[1] - self.shifts[-1]) / 2
        right, left = self.shifts[1] - eye, self.shifts[-1] - eye
        n = np.arange(self.sites) - (self.sites - 1) / 2
        return {
            COUPLING: lambda u: u @ near.T,
            "u[n]": lambda u: u,
            "u[n]**3": lambda u: u**3,
            "sin(u[n])": lambda u: np.sin(u),
            "onsite-linear": lambda u: u,
            "onsite-quadratic": lambda u: u**2,
            "onsite-cubic": lambda u: u**3,
            "onsite-quintic": lambda u: u**5,
            "constant-force": lambda u: np.ones_like(u),
            "next-neighbour": lambda u: u @ far.T,
            "quadratic-coupling": lambda u: (u @ right.T) ** 2 - (u @ left.T) ** 2,
            "nonlinear-coupling": lambda u: (u @ right.T) ** 3 + (u @ left.T) ** 3,
            "asymmetric-coupling": lambda u: u @ skew.T,
            "gradient": lambda u: n + 0 * u,
            "trap": lambda u: n**2 * u,
            **{f"defect@{k}": lambda u, row=row: u * row for k, row in enumerate(eye)},  # type: ignore[misc]
            **{
                f"bond-defect@{k}": lambda u, k=k: (u[:, k + 1] - u[:, k])[:, None] * (eye[k] - eye[k + 1])  # type: ignore[misc]
                for k in range(self.sites - 1)
            },
        }

    def rate(self, t: float, u: ndarray, v: ndarray, of: Parameters) -> ndarray:
        """Return the accelerations (copies, N).

        Args:
            t: the time since the first reading.
            u: positions (copies, N).
            v: velocities (copies, N).
            of: parameters by name, one per copy: coefficients by the name of their force, "drive.cos", "drive.sin" and
                "drive.omega", those of a drive at one site with "@0" at the end, "unequal-masses@0", by which the
                whole right-hand side of a site is scaled beyond 1, "ramp of u[n]", by how much that term's coefficient
                grows in a unit of time, it being as declared in the middle, and "step of u[n]", how much larger it is
                from the time "step when" on, which takes `SUDDEN`.
        """
        total = np.zeros_like(u)
        masses = []
        for name, value in of.items():
            if name in self.forces:
                total += value * self.forces[name](u)
            elif name in self.frictions:
                total += value * self.frictions[name](u, v)
            elif name.startswith("ramp of "):
                total += value * (t - self.span / 2) * self.forces[name.removeprefix("ramp of ")](u)
            elif name.startswith("step of "):
                share = (1 + np.tanh((t - of["step when"]) * self.fast / SUDDEN)) / 2
                total += value * share * self.forces[name.removeprefix("step of ")](u)
            elif name.startswith("unequal-masses"):
                masses.append((int(name.partition("@")[2]), value))
        for end in {name.removeprefix("drive.cos") for name in of if name.startswith("drive.cos")}:
            angle = of[f"drive.omega{end}"] * t
            force = of[f"drive.cos{end}"] * np.cos(angle) + of[f"drive.sin{end}"] * np.sin(angle)
            total[:, slice(None) if not end else [int(end[1:])]] += force
        for site, value in masses:
            total[:, site] *= 1 + value[:, 0]
        return total

    def displaced(self, outer: Mapping[int, float], of: Parameters) -> Float[ndarray, " sites"] | None:
        """Return by how much all sites stand elsewhere when outer ones do; None where forces are not linear in u.

        Args:
            outer: the displacement of each outer site; the equations of all others are kept.
            of: parameters, as `rate` takes them, each of one copy.
        """
        still = np.zeros((self.sites, self.sites))
        rest, one, two = (self.rate(0.0, k * self.size * np.eye(self.sites) + still, still, of) for k in (0, 1, 2))
        force = (one - rest).T / self.size
        if not np.allclose(two - rest, 2 * (one - rest), rtol=1e-9, atol=1e-12 * np.max(np.abs(force)) * self.size):
            return None
        found = np.array([outer.get(k, 0.0) for k in range(self.sites)])
        inner = [k for k in range(self.sites) if k not in outer]
        found[inner] = np.linalg.solve(force[np.ix_(inner, inner)], -force[inner] @ found)
        return found


LINEAR = ("u[n]", "sin(u[n])")


def shifts(sites: int, ends: Ends) -> dict[int, Float[ndarray, "sites sites"]]:
    """Return the matrices of u[n+k] for all k that the chain is long enough for, up to 2."""
    reach = 2 if sites >= 2 or ends == "fixed" else 1
    index, factor = ghosts(sites, reach, reach, ends)
    found = {}
    for k in range(-reach, reach + 1):
        matrix = np.zeros((sites, sites))
        rows = np.arange(sites)
        np.add.at(matrix, (rows, index[rows + reach + k]), factor[rows + reach + k])
        found[k] = matrix
    return found


def draw_chain(draw: np.random.Generator, sites: int | None = None) -> Chain:
    """Return a chain with its start and its times.

    Args:
        draw: for everything.
        sites: N; drawn if None, most often 1 to 3 and now and then 24.
    """
    if sites is None:
        sites = int(draw.choice([1, 2, 3, 4, 5, 6, 7, 24], p=[0.2, 0.28, 0.22, 0.07, 0.06, 0.06, 0.06, 0.05]))
    usable = [one for one in EQUATIONS if (one[2] == 1) == (sites == 1)]
    declared, every, _ = usable[int(draw.choice(len(usable), p=_weights(len(usable))))]
    # Rings are rare.
    usual = [end for end in every if end != "periodic" or (sites >= 3 and draw.uniform() < RINGS)]
    ends: Ends = usual[int(draw.integers(len(usual)))]
    unit = "rad" if "sin(u[n])" in declared else list(UNITS)[int(draw.integers(len(UNITS)))]
    low, high = RADIANS if unit == "rad" else UNITS[unit]
    size = _log_uniform(draw, low, high)
    fast = 2 * np.pi * _log_uniform(draw, SLOWEST, FASTEST)
    coefficients, squares, modes = _coefficients(draw, declared, sites, ends, fast, size)
    slow = float(np.sqrt(squares.min()))
    least = max(FEWEST_PERIODS, SLOW_PERIODS * fast / slow)
    periods = _log_uniform(draw, min(least, MOST_PERIODS), MOST_PERIODS)
    readings = int(np.clip(periods * _log_uniform(draw, PER_PERIOD, 60.0), FEWEST_READINGS, MOST_READINGS))
    start = _start(draw, squares, modes, size)
    span = periods * 2 * np.pi / fast
    return Chain(declared, coefficients, sites, ends, unit, size, start, slow, fast, span, readings)


def _weights(count: int) -> list[float]:
    return [0.4, 0.25, 0.2, 0.15] if count == 4 else [0.4, 0.35, 0.25]


def _log_uniform(draw: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(draw.uniform(np.log(low), np.log(high))))


def _coefficients(
    draw: np.random.Generator, declared: tuple[str, ...], sites: int, ends: Ends, fast: float, size: float
) -> tuple[ndarray, ndarray, ndarray]:
    """Return true coefficients, and the squared frequencies and the shapes of the modes of small swings."""
    found = dict.fromkeys(declared, 0.0)
    eye = np.eye(sites)
    near = np.zeros((sites, sites))
    if COUPLING in found:
        moved = shifts(sites, ends)
        near = moved[1] + moved[-1] - 2 * eye
        found[COUPLING] = 1.0
    own = next((text for text in LINEAR if text in found), None)
    if own is not None:
        # In proportion to the coupling; the walls' springs come in where there is a wall.
        found[own] = -1 / _log_uniform(draw, 0.05, 1.5) if COUPLING in found else -1.0
    squares, modes = np.linalg.eigh(-found.get(COUPLING, 0.0) * near - (found[own] if own else 0.0) * eye)
    scale = fast**2 / squares.max()
    values = {text: value * scale for text, value in found.items()}
    if "u[n]**3" in values:
        strength = draw.choice([-1.0, -1.0, -1.0, 0.4]) * draw.uniform(0.1, 0.6)
        values["u[n]**3"] = strength * abs(values["u[n]"]) / size**2
    return np.array([values[text] for text in declared]), squares * scale, modes


def _start(draw: np.random.Generator, squares: ndarray, modes: ndarray, size: float) -> ndarray:
    """Return a start in which every mode moves, the fast ones less, released from rest or in motion."""
    weight = draw.normal(size=len(squares)) + draw.choice([-1.0, 1.0], size=len(squares)) * 0.5
    weight *= (squares.min() / squares) ** 0.5
    phase = draw.uniform(0, 2 * np.pi, size=len(squares)) if draw.uniform() < 0.6 else np.zeros(len(squares))
    weight *= size / np.max(np.abs(modes) @ np.abs(weight))
    return np.stack([modes @ (weight * np.cos(phase)), modes @ (-weight * np.sqrt(squares) * np.sin(phase))])
