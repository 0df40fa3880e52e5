"""`latticebench inspect`: what a recording is like, before any equation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import JsonOut, SystemOption, Terms, check_places, place
from latticebench.bench.cli.reading import Columns, Files, Scale, Sort, Time, layout_of

if TYPE_CHECKING:
    from latticebench.bench.inspection import Inspection
    from latticebench.systems.lattice import Library
    from latticebench.systems.samples import Samples

EPILOG = (
    'Example:  latticebench inspect pendula.csv --time time_s --columns "theta_*_deg" --scale deg '
    '--terms "sin(u\\[n])" --out pendula.png'
)
PICTURES = (".png", ".svg", ".pdf")
# Sensors and suspicions that are shown on the screen.
SHOWN = 200


def inspect(
    files: Files,
    system: SystemOption = None,
    terms: Terms = None,
    time: Time = None,
    columns: Columns = None,
    scale: Scale = "1",
    sort: Sort = False,
    json_out: JsonOut = None,
    out: Annotated[
        Path | None,
        typer.Option(parser=place, metavar="FILE", help="Draw readings and spectrum: a .png, .svg or .pdf file."),
    ] = None,
) -> None:
    """Show what was read of a recording: sites, sampling, gaps, ranges, noise, frequencies, and what is suspicious.

    With --terms or --system it is also told whether the readings make sense in an equation with them.
    """
    from latticebench.bench.cli.arguments import kept
    from latticebench.bench.inspection import inspect as look
    from latticebench.systems.errors import InputError, unknown
    from latticebench.systems.files import write_text
    from latticebench.systems.readers import read_all

    check_places([*files, system], json=json_out, out=out)
    if out is not None and out.suffix.lower() not in PICTURES:
        raise unknown("ending", out.suffix, PICTURES, f"--out {out}")
    declared = _terms(system, terms)
    data = read_all(files, "unknown", layout_of(time, columns, scale, sort))
    found = [look(one, declared) for one in data]
    failures: list[str] = []
    if json_out is not None:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import inspection_document
        from latticebench.bench.report.units import units_of

        text = to_json(inspection_document(found, units_of(data[0].origin), provenance()))
        if json_out != "-":
            with kept(failures):
                write_text(Path(json_out), text)
    if out is not None:
        with kept(failures):
            _draw(data[0], out)
    if json_out == "-":
        print(text, end="")
    else:
        for one, samples in zip(found, data, strict=True):
            _show(one, samples)
    if failures:
        raise InputError("; ".join(failures))


def _terms(system: str | None, terms: str | None) -> Library | None:
    """Return the terms that the readings are for; None where none are given."""
    from latticebench.bench.cli.arguments import asked

    if terms is None and system is None:
        return None
    return asked(system, "equation" if terms is None else None, terms, None if system else 2)[1]


def _show(found: Inspection, samples: Samples) -> None:
    """Print what a recording is like, the suspicious first."""
    from latticebench.bench.report.screen import console, show_rows
    from latticebench.systems.errors import printable

    time, unit = samples.origin.time, samples.origin.unit
    screen = console()

    def say(text: str, style: str = "") -> None:
        screen.print(printable(text), style=style, highlight=False, markup=False, soft_wrap=True)

    say(found.source, "bold")
    for line in found.notes:
        say(f"  {line}", "dim")
    if not found.suspicious:
        say("Nothing suspicious.")
    for line in found.suspicious[:SHOWN]:
        say(f"Suspicious: {line}", "bold red")
    if len(found.suspicious) > SHOWN:
        say(f"{len(found.suspicious) - SHOWN} more are suspicious; --json has all")
    span = f"t = {found.begin:g} to {found.end:g} {time}".rstrip()
    every = f"every {found.interval:.4g} {time}".rstrip() + (", unevenly" if found.uneven else "")
    say(f"{found.sites} sites, {found.rows} rows{_also(found.seen)}; {span}, {every}")
    for begin, end in found.gaps:
        say(f"gap from t = {begin:g} to {end:g}")
    frequencies = ", ".join(f"{one:.4g}" for one in found.frequencies)
    say(f"main frequencies{f' in 1/{time}' if time else ''}: {frequencies or 'none stands out'}")
    rows = [
        [
            str(site), one.name, str(one.readings), str(one.missing), f"{one.least:.4g}", f"{one.most:.4g}",
            "not seen" if one.noise != one.noise else f"{one.noise:.2g}", f"{one.step:.3g}" if one.step else "-",
        ]
        for site, one in enumerate(found.sensors[:SHOWN], 1)
    ]  # fmt: skip
    inside = f" ({unit})" if unit else ""
    show_rows(["site", "column", "readings", "missing", f"least{inside}", f"most{inside}", "noise", "steps"], rows)
    if len(found.sensors) > SHOWN:
        say(f"{len(found.sensors) - SHOWN} more sensors; --json has all")


def _also(seen: Sequence[str]) -> str:
    names = {"v": "velocities", "f": "an input"}
    return f", with {' and '.join(names[one] for one in seen)}" if seen else ""


def _draw(samples: Samples, out: Path) -> None:
    """Draw the readings of every sensor, one above the other, and their spectrum."""
    import numpy as np
    from matplotlib.figure import Figure

    from latticebench.bench.colours import INK
    from latticebench.bench.escape import label
    from latticebench.bench.figures import save
    from latticebench.bench.plots import in_decades
    from latticebench.bench.provenance import command_line
    from latticebench.bench.report.units import axis, with_unit
    from latticebench.diagnosis.problem import Spectrum
    from latticebench.methods.engine.dynamics import split_parts

    origin = samples.origin
    values = split_parts(samples.u, samples.is_complex)[:, 0] / origin.scale
    figure = Figure(figsize=(9, 5), layout="constrained")
    readings, lines = figure.subplots(1, 2, width_ratios=(2, 1))
    middle = np.nanmean(values, axis=0)
    spacing = 1.1 * float(np.nanmax(np.abs(values - middle))) or 1.0
    readings.plot(samples.t, values - middle + spacing * np.arange(samples.sites), color=INK, linewidth=0.8)
    names = [label(one) for one in origin.columns] or [f"u{site + 1}" for site in range(samples.sites)]
    every = max(1, samples.sites // 20)
    readings.set_yticks(spacing * np.arange(samples.sites)[::every], names[::every])
    readings.set_xlabel(axis("t", origin.time))
    apart = label(with_unit(f"{spacing:.2g}", origin.unit))
    readings.set_title(f"readings about their means; {apart} from one to the next")
    spectrum = Spectrum.of(samples)
    lines.plot(spectrum.omega / (2 * np.pi), spectrum.power, color=INK, linewidth=0.8)
    if in_decades(lines):
        top = float(np.max(spectrum.power))
        lines.set_ylim(1e-8 * top, 2 * top)
    lines.set_xlabel(f"cycles per {label(origin.time) or 'unit of time'}")
    lines.set_title("mean power spectrum")
    save(figure, out, {"command": command_line()})
