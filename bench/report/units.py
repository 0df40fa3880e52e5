"""Units of a recording, as its file tells them, in what is said of it.

Readings are shown in the unit of the file, coefficients in that of the equation: u = scale * reading.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from latticebench.bench.escape import label
from latticebench.bench.report.document import Content, Number
from latticebench.systems.parser import TermError
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from latticebench.systems.samples import Origin

# Digits of a number within a sentence.
DIGITS = 4
# Numbers of effects that are times; what stands before a term that acts with a sign at every second site, or in time.
TIMES = ("delay", "at", "width", "begin", "end")
# What stands behind a term that acts for a while.
WHILE = r"\*\[[^\]]*\]$"
ZERO = r"(?:offset|drift|walk|hum|lag|jump) of \w+(?: in recording \d+ beyond others)?"
SINCE = r"(?:t|\(t[^()]*\))"
IN_TIME = (
    rf"^(?:step of |(?:\(-1\)\^k|(?:cos|sin)\([^()]*\*{SINCE}\)|exp\(-\({SINCE}/[^()]*\)\*\*2/2\)|{SINCE}/[\d.e+-]+)"
    r"\*?)"
)


class Units(Content):
    """The units of a recording; "" where one is not known.

    Attributes:
        time: of times.
        reading: of what was read.
        equation: of u in the equation.
        scale: what one unit of a reading is in the equation.
    """

    time: str
    reading: str
    equation: str
    scale: Number


UNKNOWN = Units(time="", reading="", equation="", scale=1.0)


def units_of(origin: Origin) -> Units:
    """Return the units of a recording."""
    return Units(time=origin.time, reading=origin.unit, equation=origin.becomes, scale=origin.scale)


def in_words(units: Units) -> str:
    """Return the units in one line; "" where nothing is known of them."""
    parts = [f"t in {units.time}"] if units.time else []
    if units.equation:
        parts.append(f"u in {units.equation}")
    if units.reading and units.reading != units.equation:
        parts.append(f"readings in {units.reading}")
    if units.scale != 1 and not units.equation:
        parts.append(f"u is {units.scale:g} times the reading")
    return "; ".join(parts)


def axis(name: str, unit: str) -> str:
    """Return what stands at an axis: a quantity over its unit; the quantity alone where that is not known."""
    return label(f"{name} / {f'({unit})' if '/' in unit else unit}" if unit else name)


def rate_of(unit: str, time: str) -> str:
    """Return the unit of a quantity's change in time; "" where one of both is not known."""
    return f"{unit}/{time}" if unit and time else ""


def with_unit(value: str, unit: str) -> str:
    """Return a number with its unit."""
    return f"{value} {unit}".rstrip()


def of_natural(name: str, units: Units, order: int = 2) -> tuple[float, str]:
    """Return the factor and the unit of an effect's number in its natural form, by its name.

    The number may be a coefficient of the equation: that of a term, at every site or at one, or of a term times a
    function of time.
    """
    if re.match(r"(walk|hum) of \w+$", name):
        # A standard deviation has no sign, nor has how far a hum goes to either side.
        return 1 / abs(units.scale), units.reading
    if name.startswith(("offset of ", "drift of ", "hum of ", "jump of ", "sin of ", "cos of ", "cycle of ")):
        return 1 / units.scale, units.reading
    if name == "omega":
        return 1.0, rate_of("rad", units.time)
    if name in ("gamma", "drag"):
        return 1.0, rate_of("1", units.time)
    if name in TIMES or name.endswith(" time") or name.startswith("lag "):
        return 1.0, units.time
    try:
        always = re.sub(WHILE, "", name)
        term = Term(re.sub(IN_TIME, "", re.sub(r"(?: at site \d+|\(t-[^()]*\))$", "", always)) or "1")
    except TermError:
        return 1.0, ""
    return 1.0, of_coefficient(term, order, units)


def of_coefficient(term: Term, order: int, units: Units) -> str:
    """Return the unit of a term's coefficient, such as 1/s^2 of u[n] where order is 2; "" where it is not known.

    A unit of the coefficient times that of the term is that of the highest derivative. A term that is no power of u, v
    and f has a unit only where u is an angle in radians.
    """
    if not units.time or {"t", "n"} & term.names:
        return ""
    degrees = term.degrees
    if degrees is None and units.equation == "rad" and "v" not in term.names:
        degrees = (0.0, 0.0, 0.0)
    if degrees is None or degrees[2]:
        return ""
    field, rate, _ = degrees
    if field + rate != 1 and not units.equation:
        return ""
    powers = [(units.equation, 1 - field - rate), (units.time, rate - order)]
    above = " ".join(_power(unit, power) for unit, power in powers if power > 0)
    below = " ".join(_power(unit, -power) for unit, power in powers if power < 0)
    return above if not below else f"{above or 1}/{f'({below})' if ' ' in below else below}"


def _power(unit: str, power: float) -> str:
    whole = f"({unit})" if re.search(r"\W", unit) else unit
    return whole if power == 1 else f"{whole}^{power:g}"


def of_coefficients(terms: Sequence[Term], order: int, units: Units) -> list[str]:
    """Return the unit of each term's coefficient; none at all where no unit is known."""
    found = [of_coefficient(term, order, units) for term in terms]
    return found if any(found) else []


def in_sentence(line: str, units: Units) -> str:
    """Return a sentence about an effect with its offset, drift, jump, hum or times in the units of the recording."""
    if re.search(r" angular frequency [\d.e+-]+$", line):
        line = with_unit(line, rate_of("rad", units.time))
    zero = re.fullmatch(rf"({ZERO}|lag from one sensor to the next): (\S+)(.*)", line)
    if zero:
        factor, unit = of_natural(zero[1], units)
        line = f"{zero[1]}: {with_unit(f'{float(zero[2]) * factor:.{DIGITS}g}', unit)}{zero[3]}"
    line = re.sub(r"((?:from|at) t = [\d.e+-]+)(?= on,|$)", lambda at: with_unit(at[0], units.time), line)
    return with_unit(line, units.time) if re.search(r" within [\d.e+-]+$", line) else line
