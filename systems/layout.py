"""Which columns of a table are read, as what, and in which units: recordings as laboratories write them."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.options import option, options
from latticebench.systems.samples import Origin

# What one of a unit is in the unit of the equation.
UNITS: dict[str, tuple[float, str]] = {
    "rad": (1.0, "rad"), "deg": (math.pi / 180, "rad"), "arcmin": (math.pi / 10800, "rad"), "mrad": (1e-3, "rad"),
    "urad": (1e-6, "rad"), "m": (1.0, "m"), "cm": (1e-2, "m"), "mm": (1e-3, "m"), "um": (1e-6, "m"), "nm": (1e-9, "m"),
    "V": (1.0, "V"), "mV": (1e-3, "V"), "uV": (1e-6, "V"), "A": (1.0, "A"), "mA": (1e-3, "A"),
}  # fmt: skip
# What one of a unit is in seconds.
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
OTHER = ("N", "K", "Hz", "g", "kg", "px", "C", "Pa", "W", "1")
# How else people write them.
SPELLINGS = {
    "°": "deg", "degree": "deg", "degrees": "deg", "µm": "um", "μm": "um", "µs": "us", "μs": "us", "µV": "uV",
    "μV": "uV", "µrad": "urad", "μrad": "urad", "sec": "s", "second": "s", "seconds": "s", "msec": "ms",
    "milliseconds": "ms", "radian": "rad", "radians": "rad", "volt": "V", "volts": "V", "pixel": "px", "pixels": "px",
}  # fmt: skip
STANDARD = re.compile(r"t|f|trajectory|(u|v|f|re|im)[1-9]\d{0,5}")
# What is a reading and no name.
NUMERIC = re.compile(r"[+-]?\d*[.,]?\d+([eE][+-]?\d+)?")
# A name that was meant to be one of the standard ones, so that leaving it out would be wrong.
NEARLY = re.compile(r"t|(u|v|f|re|im) ?_?\d*", re.IGNORECASE)
# Every time.
ALWAYS = (-math.inf, math.inf)
# Names that are written out in a message.
LISTED = 12


@dataclass(frozen=True)
class Layout:
    """How a recording lies in its file, where that is not as this project writes it.

    Attributes:
        time: the column of the times; "t" if None.
        columns: the columns of u, by names or patterns with * and ?; u1, u2, ... if there are none. Columns of a
            pattern come in the order of the numbers in their names, those of a list in its order.
        scale: what one unit of a reading is in the equation: a number such as "1e-3", or the unit of the readings,
            such as "deg", which become radians. It holds for u and v.
        sort: put rows in the order of their times, and average rows of the same time.
        turn: unwrap angles that jump back after a full turn. It is a full turn in the unit of the file, such as 360;
            neighbouring readings must be less than half of it apart. 0 leaves u as it is. v is never changed.
        time_scale: what one unit of the times is in the equation: a number, or the unit of the times, such as "ms",
            which become seconds. v, the change of u in one unit of the times, is divided by it.
        between: the first and the last time that are read, in the unit of the file; dates become seconds after the
            first row.
    """

    time: str | None = None
    columns: tuple[str, ...] = ()
    scale: str = "1"
    sort: bool = False
    turn: float = 0.0
    time_scale: str = "1"
    between: tuple[float, float] = ALWAYS

    @property
    def stretch(self) -> tuple[float, float]:
        """The first and the last time that are read, in the unit of the file.

        Raises:
            InputError: they are no two times, one after the other.
        """
        try:
            first, last = (float(time) for time in self.between)
        except (TypeError, ValueError):
            raise InputError(f"{option('between')}: give two times, such as (2.0, inf)") from None
        if not first < last:
            raise InputError(f"{option('between', (first, last))}: give a time and a later one; inf for the last")
        return first, last

    @property
    def period(self) -> float:
        """A full turn in the unit of the file; 0 where nothing is unwrapped.

        Raises:
            InputError: it is not finite, or less than 0.
        """
        if not (math.isfinite(self.turn) and self.turn >= 0):
            raise InputError(
                f"{option('turn', self.turn)}: a full turn is a finite number above 0 in the unit of the file, "
                "such as 360"
            )
        return self.turn

    @property
    def factor(self) -> float:
        """What one unit of a reading is in the equation.

        Raises:
            InputError: the scale is neither a positive or negative number nor a known unit.
        """
        unit = spelt(self.scale)
        if unit in UNITS:
            return UNITS[unit][0]
        value = _number(self.scale)
        if not math.isfinite(value) or value == 0:
            raise InputError(f"{unknown('scale', self.scale, UNITS, option('scale'))}; or a number such as 1e-3")
        return value

    @property
    def time_factor(self) -> float:
        """What one unit of the times is in the equation.

        Raises:
            InputError: the scale is neither a positive number nor a known unit.
        """
        unit = spelt(self.time_scale)
        if unit in TIMES:
            return TIMES[unit]
        value = _number(self.time_scale)
        if not (math.isfinite(value) and value > 0):
            told = unknown("scale", self.time_scale, TIMES, option("time-scale"))
            raise InputError(f"{told}; or a number above 0 such as 1e-3")
        return value

    @property
    def unit(self) -> str:
        """The unit of the readings that the scale names; "" where it is a number."""
        unit = spelt(self.scale)
        return unit if unit in UNITS else ""

    @property
    def time_unit(self) -> str:
        """The unit of the times that their scale names; "" where it is a number."""
        unit = spelt(self.time_scale)
        return unit if unit in TIMES else ""


def _number(text: str) -> float:
    """Return a number; NaN where a text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


@dataclass(frozen=True)
class Choice:
    """Columns that are read.

    Attributes:
        names: the name in the file by the standard name (t, u1, u2, ...).
        origin: units and names, and what a user should know.
    """

    names: Mapping[str, str]
    origin: Origin


def spelt(unit: str) -> str:
    """Return a unit as this project writes it."""
    unit = unit.strip()
    return SPELLINGS.get(unit, SPELLINGS.get(unit.lower(), unit))


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that is known, with or without brackets."""
    unit = spelt(text.strip().strip("[]()"))
    return unit in UNITS or unit in TIMES or unit in OTHER


def unit_of(name: str) -> str:
    """Return the unit that a column's name tells: `x (mm)`, `x [mm]`, `x / mm` or `x_mm`; "" where it tells none."""
    bracketed = re.fullmatch(r".*\S\s*[(\[]\s*([^()\[\]]{1,12}?)\s*[)\]]", name)
    if bracketed:
        return spelt(bracketed[1])
    last = re.fullmatch(r".+?(?:_|\s*/\s*| )([^\s_/]{1,12})", name)
    return spelt(last[1]) if last and is_unit(last[1]) and not last[1].isdigit() else ""


def choose(header: Sequence[str], layout: Layout, source: str, units: Mapping[str, str] | None = None) -> Choice:
    """Return which columns of a table are read.

    Args:
        header: their names.
        layout: what is asked for.
        source: the file.
        units: of columns, by name, where the file tells them elsewhere than in the names.

    Raises:
        InputError: a column is missing, or two of them contradict each other; the message has the options that would
            read the file.
    """
    time = layout.time or "t"
    if time not in header:
        if layout.time is not None:
            raise unknown("column", time, header, f"{source}: {option('time')}")
        raise InputError(f"{source}: there is no column t, {_told(header)}{suggestion(header, layout)}")
    chosen = _columns(header, layout, source)
    names = {time: "t"} | chosen
    for name in header:
        taken = name == "t" or (layout.columns and re.fullmatch(r"(u|re|im)\d+", name))
        if name not in names and STANDARD.fullmatch(name) and not taken:
            names[name] = name
    standard = {new: old for old, new in names.items()}
    left = [name for name in header if name not in names]
    if layout.time and time != "t" and "t" in left:
        left.remove("t")
    wrong = [name for name in left if NEARLY.fullmatch(name)] if not layout.columns else []
    if wrong:
        raise InputError(
            f"{source}: unknown column {quoted(wrong[0])}; known: u1.., v1.., f1.. or f, re1.., im1.., t, trajectory"
        )
    if not any(re.fullmatch(r"(u|re|im)\d+", new) for new in standard):
        raise InputError(
            f"{source}: give either columns u1..uN (real field) or re1..reN and im1..imN (complex field)"
            f"{suggestion(header, layout)}"
        )
    told = {name: spelt((units or {}).get(name, "").strip("[]() ")) or unit_of(name) for name in names}
    origin = _origin(layout, time, list(chosen), told, source)
    return Choice(standard, origin.noting(*_notes(layout, origin, told[time], left)))


def _columns(header: Sequence[str], layout: Layout, source: str) -> dict[str, str]:
    """Return the standard names of the columns of u that are asked for by name, in the order of sites."""
    found: list[str] = []
    for asked in layout.columns:
        for one in [asked] if asked in header else [part.strip() for part in asked.split(",")]:
            matching = [one] if one in header else _matching(header, one)
            if not matching:
                raise unknown("column", one, header, f"{source}: {option('columns')}")
            for name in matching:
                if name in found:
                    where = f"{source}: {option('columns')}"
                    raise InputError(f"{where}: {quoted(name)} is named twice; name each column once")
                found.append(name)
    if (layout.time or "t") in found:
        raise InputError(
            f"{source}: {option('columns')}: {quoted(layout.time or 't')} is the column of the times; choose others, "
            f"such as {option('columns', 'theta_*')}"
        )
    return {name: f"u{number}" for number, name in enumerate(found, 1)}


def _matching(header: Sequence[str], pattern: str) -> list[str]:
    """Return the names that match, in the order of their numbers where all of them have as many."""
    if not set(pattern) & set("*?"):
        return []
    # Brackets are a part of names here.
    translated = re.compile(fnmatch.translate(pattern.replace("[", "[[]")))
    names = [name for name in header if translated.match(name)]
    numbers = [[int(digits) for digits in re.findall(r"\d+", name)] for name in names]
    if len({len(one) for one in numbers}) > 1 or not all(numbers):
        return names
    return [name for _, name in sorted(zip(numbers, names, strict=True), key=lambda pair: pair[0])]


def _origin(layout: Layout, time: str, columns: Sequence[str], told: Mapping[str, str], source: str) -> Origin:
    """Return units and names.

    Raises:
        InputError: columns of one field have different units, or the scale is of another unit.
    """
    units = {told[name] for name in (columns or [name for name in told if re.fullmatch(r"(u|re|im)\d+", name)])}
    if len(units) > 1:
        listed = ", ".join(repr(one) for one in sorted(units))
        raise InputError(f"{source}: the columns of u are in different units ({listed}); choose those of one unit")
    unit = next(iter(units), "")
    if layout.unit and unit and unit != layout.unit:
        raise InputError(f"{source}: {option('scale', layout.scale)}: the columns say that they are in {unit}")
    unit, factor = unit or layout.unit, layout.factor
    becomes = unit if factor == 1 else UNITS[layout.unit][1] if layout.unit else ""
    if layout.time_unit and told[time] and told[time] != layout.time_unit:
        where = f"{source}: {option('time-scale', layout.time_scale)}"
        raise InputError(f"{where}: column {time} says that it is in {told[time]}")
    return Origin(
        time="s" if layout.time_unit else told[time] if layout.time_factor == 1 else "",
        unit=unit,
        scale=factor,
        becomes=becomes,
        columns=tuple(columns),
    )


def _notes(layout: Layout, origin: Origin, time: str, left: Sequence[str]) -> list[str]:
    """Return what to know about the columns: what they are read as, the times in which unit, and which are not read."""
    notes = []
    times = f"times from {layout.time or 't'}{f' in {time or layout.time_unit}' if time or layout.time_unit else ''}"
    if layout.time_factor != 1:
        times += (
            f", {origin.time} in the equation" if origin.time else f", times {layout.time_factor:g} in the equation"
        )
    if origin.columns:
        unit = f" in {origin.unit}" if origin.unit else ""
        into = f", {origin.becomes} in the equation" if origin.becomes not in ("", origin.unit) else ""
        into = into or (f", times {origin.scale:g} in the equation" if origin.scale != 1 else "")
        notes.append(f"{times}; {_sites(len(origin.columns))} from {listing(origin.columns)}{unit}{into}")
    elif layout.time_factor != 1:
        notes.append(times)
    if origin.unit in ("deg", "arcmin") and origin.scale == 1:
        notes.append(
            f"angles are taken in {origin.unit}, as they are; {option('scale', origin.unit)} makes them radians"
        )
    if left:
        notes.append(f"not read: {', '.join(quoted(name)[1:-1] for name in left[:LISTED])}"
                     f"{f' and {len(left) - LISTED} more' if len(left) > LISTED else ''}")  # fmt: skip
    return notes


def _sites(count: int) -> str:
    return f"sites 1 to {count}" if count > 1 else "site 1"


def listing(names: Sequence[str]) -> str:
    """Return names in words, long lists by their ends."""
    short = [quoted(name)[1:-1] for name in names]
    return ", ".join(short) if len(short) < 4 else f"{short[0]}, ..., {short[-1]}"


def quoted(text: str) -> str:
    """Return the beginning of a text of the user's in quotes."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _told(header: Sequence[str]) -> str:
    shown = ", ".join(quoted(name)[1:-1] for name in header[:LISTED])
    return f"but {shown}{' ...' if len(header) > LISTED else ''}"


def suggestion(header: Sequence[str], layout: Layout) -> str:
    """Return the options that would read a table, as a part of a sentence."""
    cells = [cell for name in header for cell in re.split(r"[\s;]+", name) if cell]
    if all(map(NUMERIC.fullmatch, cells)):
        columns = ",".join(["t", *(f"u{k}" for k in range(1, min(len(cells), 4)))])
        return f"; the file has no header: write a first row such as {columns} with a name for each column"
    time = layout.time or next(
        (name for name in header if re.match(r"(time|zeit|temps|t)(?![a-z])", name, re.IGNORECASE)), None
    )
    families: dict[str, list[str]] = {}
    for name in header:
        if name != time:
            families.setdefault(re.sub(r"\d+", "*", name, count=1), []).append(name)
    pattern, members = max(families.items(), key=lambda one: ("*" in one[0]) * len(one[1]), default=("", []))
    if time is None or not members or len(pattern) > 60 or ("*" not in pattern and len(families) > 1):
        such = options(time="time_s", columns="theta_*_deg")
        return f"; name the columns with {option('time')} and {option('columns')}, such as {such}"
    unit = unit_of(members[0])
    given: dict[str, str | float | bool] = {} if time == "t" else {"time": time}
    given["columns"] = pattern
    if unit in ("deg", "arcmin") and layout.scale == "1":
        given["scale"] = unit
    if unit_of(time) in set(TIMES) - {"s"} and layout.time_scale == "1":
        given["time_scale"] = unit_of(time)
    return f"; read it with {options(**given)}"
