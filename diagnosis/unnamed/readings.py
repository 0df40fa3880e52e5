"""Errors of instruments without a name: what sensors add to their readings, and what they have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting import Misreading
from latticebench.diagnosis.unnamed.course import Course, courses
from latticebench.diagnosis.unnamed.nameless import EFFECT, Nameless

if TYPE_CHECKING:
    from numpy import ndarray

    from latticebench.diagnosis.problem import Problem

# Shares of the largest reading beyond which readings are clipped; numbers of courses in time.
CLIPPED, COURSES = (0.5, 0.7, 0.85), (8, 32, 64)

Reading = Callable[["ndarray", "ndarray"], tuple["ndarray", "ndarray | float"]]
"""From times (rows,) and a motion (rows, order, parts, N) to what is added to the reading per unit of a strength, and
its derivative by the reading's own field."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Misread(Nameless):
    """A sum of errors of the readings, each with a strength.

    Attributes:
        added: what each adds.
        both: whether the velocity is that of the wrong reading, too.
    """

    added: tuple[Reading, ...]
    both: bool = False
    instrument: ClassVar[bool] = True

    @property
    def place(self) -> tuple[object, ...]:
        """What it is, where, and whether the velocity is that of the wrong reading."""
        return (*super().place, self.both)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what the errors add."""
        levels = slice(None) if self.both else slice(0, 1)
        by, slope = np.zeros((len(self.added), *field.shape)), np.zeros_like(field)
        for k, (one, strength) in enumerate(zip(self.added, self.strength, strict=True)):
            added, own = one(t, field)
            by[k, :, levels] = np.broadcast_to(added, field.shape)[:, levels]
            slope[:, levels] += strength * np.broadcast_to(own, field.shape)[:, levels]
        return Misreading(np.tensordot(self.strength, by, 1), slope, by)


def readings(problem: Problem) -> Iterator[Misread]:
    """Yield errors of all sensors in common, and between sensors."""
    chain = problem.chain
    if chain.levels > 1:
        yield _misread("readings that lag", [_rate])
    yield from _between(problem)
    yield _misread("readings clipped above", [_beyond(share * problem.scene.largest) for share in CLIPPED])
    rows = max(len(one.t) for one in problem.data)
    for number in sorted({min(one, rows // 2) for one in COURSES}):
        if number >= COURSES[0]:
            shared = [_in_time(one) for one in courses(problem.scene, number)]
            zero = [_of_part(one, k) for one in shared for k in range(chain.parts)]
            yield _misread("a zero of its own course in time, common to all sensors", zero)
            yield _misread("a gain of its own course in time, common to all sensors", [_times(one) for one in shared])
            if chain.levels > 1:
                yield _misread("a clock of its own course in time", [_late(one) for one in shared])


def _between(problem: Problem) -> Iterator[Misread]:
    """Yield errors that sensors share with others along the chain."""
    chain = problem.chain
    if chain.sites < 4:
        return
    place = (np.arange(chain.sites) - (chain.sites - 1) / 2) / ((chain.sites - 1) / 2)
    for both in (False, True)[: chain.levels]:
        yield _misread("gains that grow along the chain", [_scaled(place)], both=both)
        yield _misread("another gain of one half", [_scaled((place > 0).astype(float))], both=both)


def _misread(said: str, added: Sequence[Reading], *, both: bool = False) -> Misread:
    return Misread(
        effect=EFFECT, said=said, added=tuple(added), both=both, strength=(0.0,) * len(added)
    )  # fmt: skip


def _in_time(course: Course) -> Callable[[ndarray], ndarray]:
    """Return a course in time as a factor of fields."""
    return lambda t: course(t)[0][:, None, None]


def _of_part(course: Callable[[ndarray], ndarray], part: int) -> Reading:
    def added(t: ndarray, field: ndarray) -> tuple[ndarray, float]:
        return course(t) * (np.arange(field.shape[2]) == part)[:, None], 0.0

    return added


def _times(course: Callable[[ndarray], ndarray]) -> Reading:
    return lambda t, field: (course(t) * field, course(t))


def _late(course: Callable[[ndarray], ndarray]) -> Reading:
    return lambda t, field: (course(t) * field[:, 1:2], 0.0)


def _scaled(factor: ndarray) -> Reading:
    return lambda _, field: (factor * field, factor)


def _rate(t: ndarray, field: ndarray) -> tuple[ndarray, float]:  # noqa: ARG001
    return -field[:, 1:2], 0.0


def _beyond(level: float) -> Reading:
    """Return by how much a field is beyond a level, to either side."""

    def added(_: ndarray, field: ndarray) -> tuple[ndarray, ndarray]:
        over = np.sign(field) * np.maximum(np.abs(field) - level, 0.0)
        return over, (over != 0).astype(float)

    return added
