"""The tables of a diagnosis as rows of texts, the same on the terminal and on the page."""

from __future__ import annotations

import math

from latticebench.bench.report.content import Ranked, Report, Turn

# Entries of a ranking that people are shown.
SHOWN = 6
# So many numbers of one effect are listed.
LISTED = 10
# A forecast that is so many times as large as the readings has run away.
DIVERGED = 1000.0
# Parameters that only a program wants to know.
INNER = ("open", "reach")


def effects(report: Report) -> list[list[str]]:
    """Return effect, what, value and standard error of each number that an added effect has."""
    rows = []
    for one in report.effects:
        numbers = {**{name: v for name, v in one.parameters.items() if name not in INNER}, **one.coefficients}
        for name, value in list(numbers.items())[:LISTED]:
            error = one.stderr.get(name)
            shown = f"{value:.5g}" if isinstance(value, float) else str(value)
            rows.append([one.effect, name, shown, "" if error is None else f"{error:.2g}"])
        if len(numbers) > LISTED:
            rows.append([one.effect, f"... and {len(numbers) - LISTED} more, in the JSON", "", ""])
    return rows


def coefficients(report: Report) -> tuple[list[str], list[list[str]]]:
    """Return the declared terms with their coefficients: the heads of the columns and the rows."""
    columns = ["declared term", "before", "after", "standard error"]
    rows = [
        [text, f"{report.declared_before[text]:.6g}", f"{value:.6g}", f"{report.declared_stderr[text]:.2g}"]
        for text, value in report.declared.items()
    ]
    if report.declared_truth is not None:
        columns.append("truth")
        rows = [[*row, f"{value:.6g}"] for row, value in zip(rows, report.declared_truth.values(), strict=True)]
    return columns, rows


def errors(report: Report) -> list[list[str]]:
    """Return what an error is of, and the error before and after."""

    def share(value: float) -> str:
        if math.isnan(value):
            return "-"
        return f"{100 * value:.3g} %" if value < DIVERGED else "diverges"

    error = report.error
    rows = [
        ["residual over the noise", *(f"{one:.3g}" for one in (error.residual.before, error.residual.after))],
        ["share of the derivative that is left", share(error.dynamics.before), share(error.dynamics.after)],
        ["forecast error on held-out data", share(error.forecast.before), share(error.forecast.after)],
        [
            "information criterion (lower is better)",
            *(f"{one:.1f}" for one in (error.criterion.before, error.criterion.after)),
        ],
    ]
    if error.coefficients is not None:
        both = error.coefficients
        rows.append(["error of the declared coefficients", share(both.before), share(both.after)])
    return rows


def top(turn: Turn) -> list[Ranked]:
    """Return the entries of a ranking that people are shown: the best few, with at least one that has a name."""
    best = list(turn.ranking[:SHOWN])
    if not any(entry.named for entry in best):
        best += [entry for entry in turn.ranking if entry.named][:2]
    return best


def chance(p: float) -> str:
    """Return a p-value as text; one too small for a number is below the smallest that there is."""
    return f"{p:.1g}" if p > 1e-300 else "< 1e-300"
