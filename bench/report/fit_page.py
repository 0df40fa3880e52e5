"""A fit as one HTML file: the data, the equation on top, what it leaves, the table; no scripts, nothing from elsewhere.

The template escapes every text. Markup is only what SymPy and matplotlib write, and the style sheet.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from latticebench.bench.overlay import Overlay
from latticebench.bench.plots import panels, svg
from latticebench.bench.provenance import lines
from latticebench.bench.report import rows
from latticebench.bench.report.document import Provenance
from latticebench.bench.report.mathematics import written
from latticebench.bench.report.page import environment
from latticebench.bench.report.units import UNKNOWN, Units
from latticebench.systems.files import write_text

if TYPE_CHECKING:
    from latticebench.bench.adequacy import Adequacy
    from latticebench.methods.method import Fit

CAPTIONS = {
    "map": "The readings, site against time.",
    "sites": "Readings, and the motion of the equation that is nearest to them.",
    "residual": "What the equation leaves of the readings.",
    "learning": "The method's objective and the coefficients on the way to the fit.",
    "spectrum": "The spectrum of what it leaves.",
    "phase": "The readings in their phase plane.",
}


def write_fit_page(
    found: Fit, overlay: Overlay, quality: Adequacy, units: Units, about: Provenance | None, path: Path
) -> None:
    """Write the page of a fit, whole or not at all.

    Args:
        found: the fit.
        overlay: its readings and curves.
        quality: how well the equation fits.
        units: of the recording.
        about: where it comes from.
        path: the file.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, fit_page(found, overlay, quality, units, about))


def fit_page(
    found: Fit, overlay: Overlay, quality: Adequacy, units: Units = UNKNOWN, about: Provenance | None = None
) -> str:
    """Return the page of a fit; the arguments are those of `write_fit_page`."""
    made = environment()
    style, _, _ = made.loader.get_source(made, "diagnosis.css")  # type: ignore[union-attr]
    columns, cells = rows.fitted(found, units)
    return made.get_template("fit.html.j2").render(
        found=found, overlay=overlay, quality=quality, style=style, equation=written(found),
        columns=columns, rows=cells,
        pictures={name: (CAPTIONS[name], svg(overlay, name)) for name in panels(overlay)},
        origin=[] if about is None else [line.partition(": ")[::2] for line in lines(about.model_dump())],
    )  # fmt: skip
