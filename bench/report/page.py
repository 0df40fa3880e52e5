"""A diagnosis as one HTML file: pictures as SVG, equations as MathML, no scripts, nothing loaded from elsewhere.

The template escapes every text. Markup is only what SymPy and matplotlib write, and the style sheet.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latticebench.bench.plots import MAPPED, svg
from latticebench.bench.provenance import lines
from latticebench.bench.report import pictures, rows
from latticebench.bench.report.content import Report
from latticebench.bench.report.curves import PictureCurves
from latticebench.bench.report.document import Provenance
from latticebench.bench.report.units import in_words
from latticebench.systems.files import write_text

if TYPE_CHECKING:
    import jinja2
    import markupsafe

    from latticebench.bench.overlay import Overlay


def write_page(
    report: Report, curves: PictureCurves, about: Provenance | None, path: Path, overlay: Overlay | None = None
) -> None:
    """Write the page of a diagnosis, whole or not at all.

    Args:
        report: what it says.
        curves: what it draws.
        about: where the diagnosis comes from.
        path: the file.
        overlay: the readings, which are drawn first where they are given.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, page(report, curves, about, overlay))


def page(report: Report, curves: PictureCurves, about: Provenance | None = None, overlay: Overlay | None = None) -> str:
    """Return the page of a diagnosis; the arguments are those of `write_page`."""
    frequencies = [one.parameters["omega"] for one in report.effects if "omega" in one.parameters]
    templates = environment()
    style, _, _ = templates.loader.get_source(templates, "diagnosis.css")  # type: ignore[union-attr]
    return templates.get_template("diagnosis.html.j2").render(
        report=report, curves=curves, style=style, readings=_readings(overlay),
        pictures=pictures.draw(curves, [float(one) for one in frequencies], report.recording.units),
        effects=rows.effects(report), coefficients=rows.coefficients(report), errors=rows.errors(report),
        modes=rows.modes(report), horizons=rows.horizons(report), left=rows.left(report),
        instead=rows.instead(report), tried=_bars(report), not_chosen=rows.not_chosen(report),
        alternatives=rows.alternatives(report),
        units=in_words(report.recording.units), scale=_scale(report, curves.residual.limit),
        swing=1 < report.recording.sites < pictures.MAPPED,
        origin=[] if about is None else [line.partition(": ")[::2] for line in lines(about.model_dump())],
    )  # fmt: skip


def _readings(overlay: Overlay | None) -> list[tuple[str, str, str]]:
    """Return name, caption and picture of the readings: a map where there are sites enough, and lines."""
    if overlay is None:
        return []
    names = ["map", "sites"] if overlay.sites >= MAPPED else ["sites"]
    captions = {"map": "The readings, site against time.", "sites": "Readings, and what both equations make of them."}
    return [(name, captions[name], svg(overlay, name)) for name in names]


def environment() -> jinja2.Environment:
    """Return the templates of this package; they escape what they are given, and refuse a name that is missing."""
    import jinja2
    import markupsafe

    found = jinja2.Environment(
        loader=jinja2.PackageLoader("latticebench.bench.report", "templates"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    found.filters["digits"] = lambda value, count: f"{value:.{count}g}"
    found.filters["markup"] = markupsafe.Markup
    found.filters["typeset"] = _typeset
    return found


def _typeset(text: str) -> markupsafe.Markup:
    """Return a sentence as HTML: what stands between backticks as code, R^2 with its exponent raised."""
    import markupsafe

    whole = re.sub(r"`([^`]*)`", r"<code>\1</code>", str(markupsafe.escape(text)))
    return markupsafe.Markup(re.sub(r"\bR\^2\b", "R<sup>2</sup>", whole))


def _bars(report: Report) -> list[dict[str, Any]]:
    """Return what is shown of the candidates of the last horizon: bars of their gains, and the mark of their price."""
    shown = rows.tried(report)
    longest = max([1.0, *(value for one in shown for value in (one.gain, one.price) if math.isfinite(value))])

    def width(value: float) -> str:
        return f"{100 * min(max(value, 0.0) / longest, 1.0):.1f}"

    return [
        {
            "effect": one.effect, "gain": f"{one.gain:.1f}", "price": f"{one.price:.1f}", "width": width(one.gain),
            "mark": width(one.price), "kind": "alike" if one.gain > one.price else "",
        }
        for one in shown
    ]  # fmt: skip


def _scale(report: Report, limit: float) -> dict[str, tuple[str, ...]] | None:
    """Return colours and marks of the scale beside maps; None where there are no maps."""
    if report.recording.sites < pictures.MAPPED:
        return None
    more, less = (
        f"rgb({','.join(str(round(255 * part)) for part in colour)})" for colour in (pictures.MORE, pictures.LESS)
    )
    if report.recording.field == "complex":
        return {
            "colours": ("transparent", more),
            "marks": ("0", "size of the residual", f"{limit:.2g} × noise"),
        }
    return {"colours": (less, "transparent", more), "marks": (f"−{limit:.2g} × noise", "0", f"+{limit:.2g}")}
