"""The tables of suites as a site shows them: fits by data, library, noise and method, and what trials were named."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from latticebench.bench.colours import INK, SERIES, series
from latticebench.bench.site.folders import Folder, Table, value_of
from latticebench.bench.tables import SPREAD as SHARES

KEY = ("part", "data", "library", "method")
FITS = ("data", "library", "method", "e2")
SPREAD = ("e2_low", "e2_high", "seeds")
NOISE = "noise="
# Scores of which a figure has a logarithmic axis, and those of which it has a plain one.
LOGARITHMIC = ("e2", "einf", "spurious", "forecast_error", "residual", "conditioning", "cpu_seconds", "peak_mib")
PLAIN = ("tpr", "efficiency", "coverage", "forecast_horizon")
# Columns that say what a row is about, and the scores that stand beside the first one.
FIRST = ("part", "system", "data", "library", "noise", "method", "e2", *SPREAD, "bound", "seconds")
FILTERS = ("part", "system", "library", "noise")
# By what trials say it: the effects that were there, and whether a name was right.
TRUTHS = ("effect", "truth")


@dataclass(frozen=True)
class View:
    """A table as it is shown.

    Attributes:
        table: its columns and rows.
        filters: columns by which rows are chosen.
        figure: what the page's figure draws; nothing where there is none.
        details: of each row, what is told beside its cells: names and texts.
        note: what has to be known.
    """

    table: Table
    filters: tuple[str, ...] = ()
    figure: Mapping[str, Any] = field(default_factory=dict)
    details: tuple[tuple[tuple[str, str], ...], ...] = ()
    note: str = ""


def of_fits(folder: Folder) -> View | None:
    """Return the fits of a folder, one row for data, library, noise and method; None where it has no such table.

    Scores are those of `summary.csv`. The spread is its own where it has one, else it is made of `cases.csv` beside it
    by the same rule as in `bench.tables.summary`.
    """
    table = folder.tables.get("summary")
    if table is None or not table.has(*FITS):
        return None
    cases = _cases(folder)
    spread = _spread(table, cases)
    settings = _settings(table.said("settings"), table.column("method"))
    rows, details = [], []
    for found in table.records():
        key = _key(found)
        known = cases.get(key, [])
        system, _, setting = found["data"].partition(" ")
        words = setting.split()
        noise = next((word.removeprefix(NOISE) for word in words if word.startswith(NOISE)), "0")
        found |= {"system": system, "data": " ".join(word for word in words if not word.startswith(NOISE))}
        found |= {"noise": noise} | dict(zip(SPREAD, spread.get(key, ("", "", "")), strict=True))
        rows.append(found)
        details.append(_details(known, settings.get(found["method"], ""), table.said("seeds")))
    names = [*FIRST, *(name for name in table.columns if name not in FIRST)]
    kept = [name for name in names if name in (*FITS, "system", "noise") or any(row.get(name) for row in rows)]
    shown = Table(tuple(kept), tuple(tuple(row.get(name, "") for name in kept) for row in rows), table.about)
    figure = _figure(shown)
    note = "" if spread else "The single cases of this suite are not published, so no spread is known."
    filters = tuple(name for name in FILTERS if name in kept and len(set(shown.column(name))) > 1)
    return View(shown, filters, figure, tuple(details), note)


def _key(row: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(row.get(name, "") for name in KEY)


def _spread(table: Table, cases: Mapping[tuple[str, ...], Sequence[Mapping[str, str]]]) -> dict[Any, tuple[str, ...]]:
    """Return the middle 80 % of E2 and the number of seeds, by what a row is about; one seed has no spread."""
    known = {}
    for row in table.records():
        key = _key(row)
        if table.has(*SPREAD):
            known[key] = row["e2_low"], row["e2_high"], row["seeds"]
        # Where there is an error at all, what failed counts as an infinite one.
        elif row["e2"] and key in cases:
            ended = [one for one in cases[key] if one["status"] != "skipped"]
            errors = pd.Series([value_of(one["e2"] if one["status"] == "ok" else "inf") for one in ended], dtype=float)
            errors = errors.dropna()
            low, high = (str(errors.quantile(share, interpolation="nearest")) for share in SHARES)
            known[key] = low, high, str(len(errors))
    return {key: one if value_of(one[-1]) > 1 else ("", "", one[-1]) for key, one in known.items()}


def _cases(folder: Folder) -> dict[tuple[str, ...], list[dict[str, str]]]:
    """Return the single cases of a folder by what a row of its summary is about."""
    table = folder.tables.get("cases")
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    if table is not None and table.has("e2", "status", "seed"):
        for one in table.records():
            found.setdefault(_key(one), []).append(one)
    return found


def _settings(text: str, methods: Sequence[str]) -> dict[str, str]:
    """Take the line "one method, a=1; other method, b=2" apart, by the labels of the methods."""
    labels = sorted(set(methods), key=len, reverse=True)
    starts = "|".join(re.escape(one) for one in labels)
    pieces = re.split(rf"(?:^|; )(?=(?:{starts}) )", text)
    return {label: piece for piece in pieces for label in labels if piece.startswith(f"{label} ")}


def _details(cases: Sequence[Mapping[str, str]], settings: str, seeds: str) -> tuple[tuple[str, str], ...]:
    """Return seeds, settings and identity of what a row sums up, as far as they were published."""
    own = dict.fromkeys(one.get("settings", "") for one in cases)
    told = {
        "seeds": ", ".join(dict.fromkeys(one["seed"] for one in cases if "seed" in one)) or seeds,
        "settings": "; ".join(filter(None, [settings, *own])),
        "reason": "; ".join(dict.fromkeys(one["reason"] for one in cases if one.get("reason"))),
        "case": _identity(cases[0].get("identity", "")) if cases else "",
    }
    return tuple((name, text) for name, text in told.items() if text)


def _identity(text: str) -> str:
    """Write the settings of a case, which are JSON, as "name value" in one line."""
    try:
        found = json.loads(text)
    except ValueError:
        return text
    if not isinstance(found, dict):
        return text
    texts = {name: json.dumps(value) if isinstance(value, dict) else value for name, value in found.items()}
    return "; ".join(f"{name} {text}" for name, text in texts.items())


def _figure(table: Table) -> dict[str, Any]:
    """Return what the figure draws: errors against noise where there are several levels, else against seconds."""
    levels = {cell for cell in table.column("noise") if cell != "0"}
    methods = dict.fromkeys(table.column("method"))
    return {
        "x": [name for name in ("noise", "seconds") if table.has(name)],
        "first": "noise" if len(levels) > 1 else "seconds",
        "y": [[name, name in LOGARITHMIC] for name in (*LOGARITHMIC, *PLAIN) if table.has(name)],
        # Where the colours begin anew, lines are dotted.
        "methods": [[name, series(place), place >= len(SERIES)] for place, name in enumerate(methods)],
        "ink": INK,
    }


def of_trials(table: Table) -> Table | None:
    """Return what each effect was taken for, with how often; None where a table is not one of trials."""
    truth = next((name for name in TRUTHS if table.has(name, "named", "right", "status")), None)
    if truth is None:
        return None
    named: dict[str, Counter[str]] = {}
    right: Counter[str] = Counter()
    for one in table.records():
        if one["status"] == "ok":
            # How large an effect was is told after it.
            effect = re.sub(r" z=\S+", "", one[truth]) or "none"
            named.setdefault(effect, Counter())[one["named"] or "nothing"] += 1
            right[effect] += one["right"] == "True"
    rows = [
        (effect, str(counts.total()), str(right[effect]), ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        for effect, counts in sorted(named.items())
    ]
    return Table(("effect", "trials", "right", "what was named, and how often"), tuple(rows), table.about)
