"""A diagnosis on the terminal."""

from __future__ import annotations

from latticebench.bench.report import rows
from latticebench.bench.report.content import Report, Turn
from latticebench.bench.report.screen import console, show_rows


def show(report: Report) -> None:
    """Print a diagnosis."""
    _say(report.sentence, "bold")
    _say(f"\nnoise: {report.noise:.3g}")
    equations = [("declared", report.equation.before)]
    if report.effects:
        equations.append(("with what was found", report.equation.after))
    for name, equation in equations:
        _say(f"{name}: {equation.text}")
        for line in equation.elsewhere:
            _say(f"    {line}")
    if report.effects:
        _say("\nEffects", "bold")
        show_rows(["effect", "what", "value", "standard error"], rows.effects(report))
    for number, turn in enumerate(report.rounds, start=1):
        _show_round(number, turn)
    for one in report.separations:
        _say(f"{one.effect} cannot be told from {one.other} here. What would separate them: {one.measurement}.")
    show_rows(["error", "before", "after"], rows.errors(report))
    show_rows(*rows.coefficients(report))
    _say("Where the residual of the declared equation lives", "bold")
    for line in report.where.before.words:
        _say(line)
    if report.left and report.effects:
        _say("Where the residual that is left lives", "bold")
        for line in report.where.after.words:
            _say(line)
    for line in report.notes:
        _say(line, "dim")


def _show_round(number: int, turn: Turn) -> None:
    _say(f"Round {number}: {'added ' + turn.added if turn.added else 'nothing added'}", "bold")
    entries = [
        [entry.effect if entry.named else f"(no name) {entry.effect}", f"{entry.evidence:.1f}", rows.chance(entry.p)]
        for entry in rows.top(turn)
    ]
    show_rows(["effect", "evidence", "p"], entries)


def _say(text: str, style: str = "") -> None:
    console().print(text, style=style, highlight=False, markup=False, soft_wrap=True)
