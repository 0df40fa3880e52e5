"""The tables of a fit and of a diagnosis as rows of texts, the same on the terminal and on the page."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from latticebench.bench.report.units import WHILE, Units, of_coefficients, with_unit
from latticebench.diagnosis import rules

if TYPE_CHECKING:
    import pandas as pd

    from latticebench.bench.report.content import Left, Report
    from latticebench.bench.report.horizons import Candidate
    from latticebench.bench.report.modes import Mode
    from latticebench.methods.method import Fit

Table = tuple[list[str], list[list[str]]]

# Candidates that people are shown.
SHOWN = 8
# So many numbers of one effect, and so many peaks, are listed.
LISTED = 10
# A forecast that is so many times as large as the readings has run away.
DIVERGED = 1000.0


def fitted(found: Fit, units: Units) -> Table:
    """Return the terms of a fit with their coefficients, standard errors and units, as far as they are known."""
    texts = found.library.texts
    columns = {"term": list(texts), "coefficient": [f"{value:.6g}" for value in found.coefficients.tolist()]}
    if found.stderr is not None:
        columns["standard error"] = [f"{error:.2g}" for error in found.stderr.tolist()]
    if own := of_coefficients(found.library.terms, found.order, units):
        columns["unit"] = own
    return list(columns), [list(row) for row in zip(*columns.values(), strict=True)]


def effects(report: Report) -> Table:
    """Return effect, what, value and standard error of each number that an added effect has."""
    rows = []
    for one in report.effects:
        numbers = [
            [name, f"{value:.5g}" if isinstance(value, float) else str(value), _error(one.stderr.get(name))]
            for name, value in one.parameters.items()
            if name not in one.natural
        ]
        numbers += [
            [name, with_unit(f"{size.value:.5g}", size.unit), _error(size.stderr)] for name, size in one.natural.items()
        ]
        rows += [[one.effect, *row] for row in numbers[:LISTED]]
        if len(numbers) > LISTED:
            rows.append([one.effect, f"... and {len(numbers) - LISTED} more, in the JSON", "", ""])
    return ["effect", "what", "value", "standard error"], rows


def _error(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.2g}"


def alternatives(report: Report) -> list[tuple[str, str, str]]:
    """Return each effect with those that cannot be told from it, and one measurement that would separate them."""
    found: dict[tuple[str, str], list[str]] = {}
    for one in report.separations:
        found.setdefault((one.effect, one.measurement), []).append(one.other)
    return [(effect, ", ".join(others), measurement) for (effect, measurement), others in found.items()]


def coefficients(report: Report) -> Table:
    """Return the declared terms with their coefficients."""
    columns = ["declared term", "before", "after", "standard error"]
    rows = [
        [text, f"{report.declared_before[text]:.6g}", f"{value:.6g}", f"{report.declared_stderr[text]:.2g}"]
        for text, value in report.declared.items()
    ]
    if report.declared_units:
        columns.append("unit")
        rows = [[*row, unit] for row, unit in zip(rows, report.declared_units.values(), strict=True)]
    if report.declared_truth is not None:
        columns.append("truth")
        rows = [[*row, f"{value:.6g}"] for row, value in zip(rows, report.declared_truth.values(), strict=True)]
    return columns, rows


def errors(report: Report) -> Table:
    """Return what an error is of, and the error before and after."""

    def share(value: float) -> str:
        if math.isnan(value):
            return "-"
        return f"{100 * value:.3g} %" if value < DIVERGED else "diverges"

    def nats(value: float) -> str:
        # Over pieces of unlike lengths the two cannot be compared.
        return "-" if math.isnan(report.error.criterion.after) else f"{value:.1f}"

    error, unit = report.error, report.recording.units.reading or "the units of the readings"
    rows = [
        ["residual over the noise", *(f"{one:.3g}" for one in (error.residual.before, error.residual.after))],
        [
            f"residual in {unit}" if unit else "residual in the units of the readings",
            *(f"{one:.3g}" for one in (error.rms.before, error.rms.after)),
        ],
        ["share of the derivative that is left", share(error.dynamics.before), share(error.dynamics.after)],
        ["forecast error on held-out data", *map(share, (error.forecast.before, error.forecast.after))],
        ["forecast error by noise alone", *map(share, (error.forecast_by_noise, error.forecast_by_noise))],
        ["information criterion (lower is better)", *map(nats, (error.criterion.before, error.criterion.after))],
    ]
    if error.coefficients is not None:
        both = error.coefficients
        rows.append(["error of the declared coefficients", share(both.before), share(both.after)])
    return ["error", "before", "after"], rows


def modes(report: Report) -> Table:
    """Return each peak of the recording's spectrum with the nearest mode of the models, and how long that lasts.

    Where an effect swings nearer to the peak than a mode of the last model, it stands there with its name. Where the
    spectrum has no peaks, the modes of the last model are listed.
    """
    unit = report.recording.units.time
    time = f" ({unit})" if unit else ""
    peak = f"peak of the recording{f' (rad/{unit})' if unit else ''}"
    columns = [peak, "mode before", "mode after", f"decay time before{time}", f"decay time after{time}"]
    every, rows = report.modes, []
    places = [one.frequency for one in every.recording] or [one.frequency for one in every.after]
    for place in places[:LISTED]:
        pair = [_nearest(side, place) for side in (every.before, every.after)]
        shown = [_swing(one) for one in pair] + [_decay_time(one) for one in pair]
        line = min(_lines(report), key=lambda one: abs(one[0] - place), default=None)
        if line and (pair[1] is None or abs(line[0] - place) < abs(pair[1].frequency - place)):
            shown[1::2] = [f"{line[0]:.5g}, {line[1]}", "none"]
        rows.append([f"{place:.5g}" if every.recording else "-", *shown])
    if len(places) > LISTED:
        rows.append([f"... and {len(places) - LISTED} more, in the JSON", "", "", "", ""])
    return columns, rows


def _lines(report: Report) -> list[tuple[float, str]]:
    """Return the frequencies of what swings from outside, forces and hum, with the names of these effects."""
    return [
        (float(one.parameters["omega"]), one.effect)
        for one in report.effects
        if "omega" in one.parameters
        and all(re.sub(WHILE, "", name).removesuffix("*i*1").endswith(")") for name in one.coefficients)
    ]


def _nearest(modes: tuple[Mode, ...], place: float) -> Mode | None:
    return min(modes, key=lambda one: abs(one.frequency - place), default=None)


def _swing(one: Mode | None) -> str:
    return "-" if one is None else f"{one.frequency:.5g}"


def _decay_time(one: Mode | None) -> str:
    if one is None or math.isnan(one.decay):
        return "-"
    if one.decay == 0:
        return "none"
    return f"{1 / one.decay:.4g}" if one.decay > 0 else f"grows, {-1 / one.decay:.4g}"


def horizons(report: Report) -> Table:
    """Return each horizon with the leading model, and how far the rivals were behind it."""
    rows = []
    for one in report.horizons:
        named = [" + ".join(model.effects) or "the declared equation" for model in one.models]
        rivals = [f"{name} ({model.behind:.1f})" for name, model in zip(named[1:], one.models[1:], strict=True)]
        rows.append([str(one.samples), f"{one.periods:.2g}", named[0] if named else "-", "; ".join(rivals)])
    return ["samples", "periods", "leading model", "rivals (nats behind)"], rows


def tried(report: Report) -> list[Candidate]:
    """Return the candidates of the last horizon that people are shown."""
    return list(report.horizons[-1].tried[:SHOWN]) if report.horizons else []


def not_chosen(report: Report) -> list[str]:
    """Return why candidates whose gain is high were not taken."""
    shown, found = tried(report), []
    if len(report.effects) >= rules.MOST_EFFECTS:
        found.append(f"The model has {rules.MOST_EFFECTS} effects, the most that it may have: no more were fitted.")
    elif any(one.gain > one.price for one in shown):
        found.append(
            "A gain is what the equation promises as far as it is linear. The best of those above their price were "
            "fitted in full, beside all that was found: none of these fits was better by its price."
        )
    if shown and report.horizons[-1].misfit:
        found.append(
            "The model leaves far more than noise, where gains say little: a candidate has to take away "
            f"{100 * rules.SHARE:g} % of what is left, one with a frequency or a time of its own "
            f"{100 * rules.SHARE_TIMED:g} %, and its price says so."
        )
    return found


def left(report: Report) -> Table:
    """Return what is significant in the last residual, the plainest first."""
    every = [one for one in report.left if not one.instead]
    rows = [[one.effect, _place(one), f"{one.gain:.1f}", f"{one.price:.1f}"] for one in every[:SHOWN]]
    if len(every) > SHOWN:
        rows.append([f"... and {len(every) - SHOWN} more, in the JSON", "", "", ""])
    return ["what", "site", "gain", "price"], rows


def instead(report: Report) -> Table:
    """Return what does better than effects that were named."""
    rows = [[one.effect, _place(one), ", ".join(one.instead), f"{one.gain:.1f}"] for one in report.left if one.instead]
    return ["what", "site", "in the place of", "better by"], rows


def _place(one: Left) -> str:
    return "" if one.site is None else str(one.site)


def html_table(frame: pd.DataFrame, *, index: bool = False) -> str:
    """Return a table as an element of HTML, numbers with five digits."""
    return str(frame.to_html(index=index, float_format=lambda value: f"{value:.5g}", border=0))
