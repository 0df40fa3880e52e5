"""Dry friction over one step of the integrator.

The term sign(v) jumps where a site turns round, and holds a site that is at rest. Over a step, v follows a parabola
closely, so it is known beforehand where it passes through zero, and what sign(v) is before and after. In its place
stands a straight line in time with the same mean and the same first moment: what friction does to u and v until the end
of the step is then right, and the integrator meets no jump.

After a site has turned it slides back if the other forces are stronger than the friction. Else it stays where it is,
and friction is as large as these (as in Moreau's time stepping, Nonsmooth Mechanics and Applications (1988)).

A fit that is far from the motion needs forces without jumps: tanh(v / rest) may stand for sign(v), and is averaged
along the same parabola.

The place of a turn depends on the motion: it moves by minus the change of v there over the slope of v. Both averages
depend on that place, and on the forces that hold a site which stays. All this is for steps forward in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Points of Gauss and Legendre in a step, and their shares of it.
POINTS, SHARES = (np.array(one) for one in np.polynomial.legendre.leggauss(16))
POINTS, SHARES = (1 + POINTS) / 2, SHARES / 2
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class Course:
    """A parabola that the speed of each site follows over a step, at shares x of the step from 0 to 1.

    Attributes:
        v: at the beginning.
        early, middle: accelerations at the beginning and in the middle, times the length of the step; speeds as well.
    """

    v: Float[ndarray, "batch moving"]
    early: Float[ndarray, "batch moving"]
    middle: Float[ndarray, "batch moving"]

    def speed(self, x: float | ndarray) -> ndarray:
        """Return v."""
        return np.asarray(self.v + x * (self.early + x * (self.middle - self.early)))

    def slope(self, x: float | ndarray) -> ndarray:
        """Return the derivative of v by x."""
        return np.asarray(self.early + 2 * x * (self.middle - self.early))

    def turning(self) -> Float[ndarray, "batch moving"]:
        """Return where v first passes through zero, 0 where it begins there; 1 where it does not."""
        bend = self.middle - self.early
        with np.errstate(all="ignore"):
            # The formula without cancellation (Press et al., Numerical Recipes (2007), section 5.6).
            half = -(self.early + np.copysign(np.sqrt(self.early**2 - 4 * bend * self.v), self.early)) / 2
            both = np.stack([half / bend, self.v / half])
        first = np.min(np.where(both > 0, both, 1.0), axis=0)
        return np.where(self.v == 0, 0.0, np.minimum(first, 1.0))


@dataclass(frozen=True, eq=False)
class Sliding:
    """A straight line that stands for sign(v) over a step, mean + trend (x - 1/2), and how it follows from the motion.

    Attributes:
        mean, trend: of the line; dimensionless.
        by: derivatives of both by v, early and middle of the course, and by the pull, which is the coefficient of
            sign(v) times the length of the step.
    """

    mean: Float[ndarray, "batch moving"]
    trend: Float[ndarray, "batch moving"]
    by: Float[ndarray, "2 4 batch moving"]

    @classmethod
    def abrupt(cls, course: Course, pull: Float[ndarray, "batch moving"]) -> Sliding:
        """Return the line for sign(v), where the accelerations of the course are those before the site turns."""
        before, turn = np.sign(course.v), course.turning()
        left, turns = 1 - turn, turn < 1
        # The force of all else between the turn and the end of the step.
        force = course.slope((1 + turn) / 2) - pull * before
        with np.errstate(all="ignore"):
            after = np.where(pull < 0, np.clip(-force / pull, -1.0, 1.0), np.sign(force))
            sticks = turns & (pull < 0) & (np.abs(after) < 1)
            slope = course.slope(turn)
            slope = np.where(np.abs(slope) > TINY, slope, np.inf)
            by_speed = np.where(sticks, -1 / pull, (after - before) / slope)
            by_force = np.where(sticks, -1 / pull, 0.0)
            # The later a site comes to rest, the later are the forces that hold it.
            later = np.where(sticks, 6 * left**2 * (course.middle - course.early) / (pull * slope), 0.0)
        # A site that slides off from rest does so as the step begins, even if it moves a little that way already.
        by_speed = np.where(turns & (sticks | (course.v != 0)), by_speed, 0.0)
        mean = before * turn + after * left
        trend = 6 * turn * left * (after - before)
        by = _along(turn[None], by_speed[None])
        for row, share in enumerate((left, 6 * turn * left)):
            held = share * by_force
            by[row, 1] -= turn * held
            by[row, 2] += (1 + turn) * held
            by[row, 3] += (after - before) * held
        by[1, :3] += later * np.stack([np.ones_like(turn), turn - turn**2, turn**2])
        return cls(mean, trend, by)

    @classmethod
    def soft(cls, course: Course, rest: float) -> Sliding:
        """Return the line for tanh(v / rest)."""
        x = POINTS[:, None, None]
        value = np.tanh(course.speed(x) / rest)
        share = SHARES[:, None, None]
        mean = np.sum(share * value, axis=0)
        trend = 12 * np.sum(share * (x - 0.5) * value, axis=0)
        return cls(mean, trend, _along(x, share * (1 - value**2) / rest))

    def at(self, x: float) -> Float[ndarray, "batch moving"]:
        """Return the line at a share of the step."""
        return np.asarray(self.mean + (x - 0.5) * self.trend)


def _along(x: Float[ndarray, "point batch moving"], by_speed: Float[ndarray, "point batch moving"]) -> ndarray:
    """Return the derivatives of mean and trend, where that of the mean by v at each point is known."""
    found = np.zeros((2, 4, *by_speed.shape[1:]))
    for row, weight in enumerate((by_speed, 12 * (x - 0.5) * by_speed)):
        first, second = np.sum(x * weight, axis=0), np.sum(x**2 * weight, axis=0)
        found[row, :3] = np.sum(weight, axis=0), first - second, second
    return found
