"""How much a suite or a simulation asks for, as far as one can know before: what is absurd is refused unless confirmed.

Counted are cases, the memory that the samples take at least, and the time that is simulated. How long a fit takes is
known where it ran before (`bench.estimate`); elsewhere its time limit is the most that it may.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from latticebench.bench.case import Case
from latticebench.systems.errors import InputError

MOST_CASES = 10**6
# In units of the equation's time, over all trajectories: 10^8 steps of the paper's integrator, about an hour.
MOST_TIME = 1e5
# Hours that all cases may take together, by their limits, on as many workers as are asked for: a year.
MOST_HOURS = 8760
# Hours of work, by what the same cases took before, that nobody starts in passing.
MOST_KNOWN_HOURS = 5
TOLD_HOURS = 1
# u as it is and as it is seen, and its rate, in bytes of double precision.
BYTES_OF_A_VALUE = 24
CONFIRM = "if it is meant so, confirm it with --yes"


def check_cases(count: int, where: str) -> None:
    """Refuse more than MOST_CASES cases.

    Raises:
        InputError: there are more; `where` is the place in the suite.
    """
    if count > MOST_CASES:
        raise InputError(f"{where}: {_rounded(count)} cases, at most {MOST_CASES} are made unasked; {CONFIRM}")


def check_size(case: Case, sites: int, where: str, remedy: str = CONFIRM) -> None:
    """Refuse a case whose samples alone do not fit into its memory limit or the machine, or take very long to simulate.

    Args:
        case: what describes the samples.
        sites: their number.
        where: the place of the case, for the message.
        remedy: what to do if it is meant so, for the message.

    Raises:
        InputError: it asks for more.
    """
    import psutil

    samples, trajectories = (int(getattr(case, name, 1)) for name in ("samples", "trajectories"))
    needed = BYTES_OF_A_VALUE * sites * samples * trajectories
    limit = min(case.memory_limit * 2**20, psutil.virtual_memory().total)
    if needed > limit:
        raise InputError(
            f"{where}: {_rounded(sites)} sites x {_rounded(samples)} samples x {_rounded(trajectories)} trajectories "
            f"take {_rounded(needed // 2**20)} MiB at least, and {limit // 2**20} may be used; {remedy}"
        )
    if trajectories > MOST_TIME or getattr(case, "span", 0.0) * trajectories > MOST_TIME:
        raise InputError(
            f"{where}: a time of {case.span:g} in {_rounded(trajectories)} trajectories"  # type: ignore[attr-defined]
            f" takes more than an hour to simulate (from {MOST_TIME:g} together); {remedy}"
        )


def hours(cases: Iterable[Case], jobs: int) -> float:
    """Return how many hours cases take on so many workers if each needs all of its time limit."""
    return sum(one.time_limit for one in cases) / jobs / 3600


def check_hours(most: float, where: str) -> None:
    """Refuse more than MOST_HOURS.

    Raises:
        InputError: there are more.
    """
    if most > MOST_HOURS:
        raise InputError(f"{where}: by its time limits it may take {most:.0f} hours on these workers; {CONFIRM}")


def check_known_hours(known: float, where: str) -> None:
    """Refuse more than MOST_KNOWN_HOURS.

    Raises:
        InputError: there are more.
    """
    if known > MOST_KNOWN_HOURS:
        raise InputError(
            f"{where}: by what its cases took before it takes {known:.1f} hours on these workers; {CONFIRM}"
        )


def _rounded(number: int) -> str:
    """Write a whole number of any size."""
    return str(number) if number < 10**9 else f"10^{math.log10(number):.1f}"
