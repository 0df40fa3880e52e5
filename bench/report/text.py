"""A diagnosis on the terminal."""

from __future__ import annotations

from latticebench.bench.report import rows
from latticebench.bench.report.content import Report
from latticebench.bench.report.screen import console, show_rows
from latticebench.bench.report.units import in_words


def show(report: Report) -> None:
    """Print a diagnosis."""
    _say(report.sentence, "bold")
    _say("\nNoise", "bold")
    for line in report.noise_lines:
        _say(line)
    _show_equations(report)
    if report.effects:
        _say("\nEffects", "bold")
        show_rows(*rows.effects(report))
    for effect, others, measurement in rows.alternatives(report):
        _say(f"{effect} cannot be told from {others} here. What would separate them: {measurement}.")
    show_rows(*rows.errors(report))
    show_rows(*rows.coefficients(report))
    _show_table("Angular frequencies", rows.modes(report))
    _say("Where the residual of the declared equation lives", "bold")
    for line in report.where.before.words:
        _say(line)
    if report.left and report.effects:
        _say("Where the residual that is left lives", "bold")
        for line in report.where.after.words:
            _say(line)
    _show_search(report)
    for line in report.notes:
        _say(line, "dim")


def _show_equations(report: Report) -> None:
    _say("\nEquation", "bold")
    equations = [("declared", report.equation.before)]
    if report.effects:
        equations.append(("with what was found", report.equation.after))
    for name, equation in equations:
        _say(f"{name}: {equation.text}")
        for line in equation.elsewhere:
            _say(f"    {line}")
    units = in_words(report.recording.units)
    if units:
        _say(f"units: {units}")


def _show_search(report: Report) -> None:
    """Print how the search went."""
    _show_table("\nHow the search went: longer and longer pieces were followed", rows.horizons(report))
    candidates = [[one.effect, f"{one.gain:.1f}", f"{one.price:.1f}"] for one in rows.tried(report)]
    _show_table("What else was tried at last, in nats", (["effect", "gain", "price"], candidates))
    for line in rows.not_chosen(report):
        _say(line)
    _show_table("What is left without a name, in nats", rows.left(report))
    _show_table("What does better without a name, in nats", rows.instead(report))


def _show_table(title: str, table: rows.Table) -> None:
    """Print a table under its title; nothing where it has no rows."""
    if table[1]:
        _say(title, "bold")
        show_rows(*table)


def _say(text: str, style: str = "") -> None:
    console().print(text, style=style, highlight=False, markup=False, soft_wrap=True)
