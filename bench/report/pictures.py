"""The pictures of a diagnosis, drawn with matplotlib as SVG.

They are drawn in stand-in colours that the style sheet of the page sets, so that they follow a light or a dark screen.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.curves import PictureCurves, ResidualCurve, WorstForecast, forecast_error
from latticebench.bench.report.units import UNKNOWN, Units, axis, rate_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Stand-in colours, and what the style sheet calls them.
INK, BEFORE, AFTER, FAINT = "#010101", "#020202", "#030303", "#040404"
STYLES = {INK: "currentColor", BEFORE: "var(--before)", AFTER: "var(--after)", FAINT: "var(--line)"}
MORE, LESS = (0.80, 0.20, 0.18), (0.13, 0.42, 0.80)
# Columns of a map and points of a line: more cannot be seen.
COLUMNS, POINTS = 400, 1200
# Chains shorter than this are drawn as lines: a map would have too few rows.
MAPPED = 4
WIDTH, HEIGHT = 5.0, 3.0


def draw(curves: PictureCurves, frequencies: Sequence[float], units: Units = UNKNOWN) -> dict[str, str]:
    """Return the pictures of a diagnosis as SVG elements, by name: maps, spectrum, forecast and its growth.

    Args:
        curves: what is drawn.
        frequencies: angular ones that were found, to be marked in the spectrum.
        units: of the recording.
    """
    residual = curves.residual
    sides = [("before", residual.before, BEFORE), ("after", residual.after, AFTER)]
    shown = [(name, curve, colour) for name, curve, colour in sides if curve is not None]
    drawn = {
        f"map-{name}": residual_over_time(curve, residual.limit, colour, units.time) for name, curve, colour in shown
    }
    drawn["spectrum"] = spectrum(
        [(colour, curve.omega, curve.power) for _, curve, colour in shown], frequencies, units.time
    )
    drawn["forecast"] = prediction(curves.forecast, units)
    drawn["growth"] = growth(curves.forecast, units.time)
    return drawn


def residual_over_time(curve: ResidualCurve, limit: float, colour: str, time: str = "") -> str:
    """Draw a residual site against time: as a map, or for a few sites as lines."""
    if curve.values.shape[-1] >= MAPPED:
        return site_map(curve.t, curve.values, limit, time)
    return traces(curve.t, curve.values, limit, colour, time)


def _axes() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=11)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.xaxis.label.set_fontsize(12)
    axes.yaxis.label.set_fontsize(12)
    return figure, axes


def _svg(figure: Figure, salt: str) -> str:
    """Write a figure as an SVG element that takes its colours from the page."""
    import matplotlib as mpl

    written = io.StringIO()
    # Letters stay letters: they can be searched, read aloud, and follow the page's font.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(
            written,
            format="svg",
            transparent=True,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    text = written.getvalue()
    text = text[text.index("<svg ") :]
    for colour, style in STYLES.items():
        text = text.replace(colour, style)
    begin = text.index(">")
    words = [word for word in text[:begin].split(" ") if not word.startswith(("width=", "height=", "version="))]
    return " ".join(words) + text[begin:]


def site_map(t: np.ndarray, left: np.ndarray, limit: float, time: str = "") -> str:
    """Draw a residual (T, parts, N), site against time; nothing left is transparent."""
    from matplotlib.ticker import MaxNLocator

    signed = left[:, 0] if left.shape[1] == 1 else np.sqrt(np.mean(left**2, axis=1))
    columns = min(len(t), COLUMNS)
    shown = np.full((columns, signed.shape[1]), np.nan)
    # Columns are evenly spaced even where times are not: each shows the largest value near it.
    near = np.linspace(t[0], t[-1], columns)
    owner = np.clip(np.round((t - t[0]) / (t[-1] - t[0]) * (columns - 1)).astype(int), 0, columns - 1)
    for column in range(columns):
        rows = np.flatnonzero(owner == column)
        if not len(rows):
            rows = np.array([int(np.argmin(np.abs(t - near[column])))])
        block = signed[rows]
        largest = np.argmax(np.nan_to_num(np.abs(block), nan=-1.0), axis=0)
        shown[column] = block[largest, np.arange(block.shape[1])]
    values = shown.T
    image = np.zeros((*values.shape, 4))
    image[..., :3] = np.where((values >= 0)[..., None], MORE, LESS)
    image[..., 3] = np.minimum(np.nan_to_num(np.abs(values)) / limit, 1.0)
    image[~np.isfinite(values)] = (0.5, 0.5, 0.5, 0.25)
    figure, axes = _axes()
    half = (t[-1] - t[0]) / max(columns - 1, 1) / 2
    axes.imshow(
        image, aspect="auto", origin="lower", interpolation="none",
        extent=(t[0] - half, t[-1] + half, 0.5, values.shape[0] + 0.5),
    )  # fmt: skip
    axes.set_xlabel(axis("t", time))
    axes.set_ylabel("site")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return _svg(figure, f"map {float(np.nansum(np.abs(values))):.6g}")


def thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a long line with the smallest and the largest value of each stretch."""
    if len(t) <= POINTS:
        return t, values
    edges = np.linspace(0, len(t), POINTS // 2 + 1).astype(int)
    kept = []
    for begin, end in itertools.pairwise(edges):
        block = np.nan_to_num(values[begin:end], nan=0.0)
        kept += sorted({begin + int(np.argmin(block)), begin + int(np.argmax(block))})
    return t[kept], values[kept]


def traces(t: np.ndarray, left: np.ndarray, limit: float, colour: str, time: str = "") -> str:
    """Draw the residual (T, parts, N) of a few sites as lines, one above the other."""
    figure, axes = _axes()
    gap = 2.2 * limit
    sites = left.shape[-1]
    for site in range(sites):
        for part in range(left.shape[1]):
            x, y = thinned(t, left[:, part, site])
            axes.plot(
                x,
                np.clip(y, -limit, limit) + gap * (sites - 1 - site),
                color=colour,
                linewidth=0.8,
                alpha=1.0 if part == 0 else 0.6,
            )
    axes.set_ylim(-gap / 2, gap * (sites - 0.5))
    centres = [gap * (sites - 1 - site) for site in range(sites)]
    if sites == 1:
        axes.set_ylabel("residual / noise")
    else:
        axes.set_yticks(centres, [f"site {site + 1}" for site in range(sites)])
    axes.set_xlabel(axis("t", time))
    return _svg(figure, f"traces {colour}")


def spectrum(lines: Sequence[tuple[str, np.ndarray, np.ndarray]], found: Sequence[float], time: str = "") -> str:
    """Draw spectra (colour, frequencies, powers), with the frequencies that were found as dotted lines."""
    from matplotlib.ticker import LogLocator, NullLocator

    figure, axes = _axes()
    lowest, highest = 1.0, 1.0
    for colour, omega, power in lines:
        x, y = omega, np.maximum(power, 1e-3)
        if len(x) > COLUMNS:
            edges = np.unique(np.linspace(0, len(x), COLUMNS + 1).astype(int))
            # The lines of a spectrum must not be averaged away.
            x, y = (x[edges[:-1]] + x[edges[1:] - 1]) / 2, np.maximum.reduceat(y, edges[:-1])
        axes.plot(x, y, color=colour, linewidth=1.8)
        if len(y):
            lowest, highest = min(lowest, float(np.min(y))), max(highest, float(np.max(y)))
    for line in found:
        axes.axvline(line, color=AFTER, linewidth=1, linestyle=":")
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--")
    # Powers of ten as plain numbers: superscripts would need a font that a browser may lack.
    axes.set_yscale("log")
    axes.set_ylim(lowest / 1.5, highest * 1.5)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if highest < 100 * lowest else (1.0,)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(axis("angular frequency", rate_of("rad", time)))
    axes.set_ylabel("power / noise")
    return _svg(figure, "spectrum")


def prediction(shown: WorstForecast, units: Units = UNKNOWN) -> str:
    """Draw the readings of one site and what the equations predict for it, in the unit of the file if it is known."""
    scale = units.scale if units.reading else 1.0
    site = shown.site - 1
    figure, axes = _axes()
    sides = [
        (one, *kind) for one, kind in ((shown.before, (BEFORE, "--")), (shown.after, (AFTER, "-"))) if one is not None
    ]
    seen = np.concatenate([one.seen[:, 0, site] / scale for one, _, _ in sides])
    seen = seen[np.isfinite(seen)]
    low, high = (float(np.min(seen)), float(np.max(seen))) if len(seen) else (-1.0, 1.0)
    # A forecast that runs away must not hide the readings.
    room = 0.6 * (high - low) + 1e-9 * max(abs(low), abs(high)) or 1.0
    for one, _, _ in sides:
        t, values = thinned(one.t, one.seen[:, 0, site] / scale)
        dense = len(one.t) > 150
        style = "-" if len(one.t) > POINTS else "o"
        axes.plot(t, values, style, color=INK, markersize=2.0 if dense else 4.0, linewidth=0.8)
    for one, colour, style in sides:
        t, values = thinned(one.t, np.clip(one.predicted[:, 0, site] / scale, low - 2 * room, high + 2 * room))
        axes.plot(t, values, style, color=colour, linewidth=1.8)
    axes.set_ylim(low - room, high + room)
    axes.set_xlabel(axis("t", units.time))
    axes.set_ylabel(axis(f"u at site {site + 1}", units.reading))
    return _svg(figure, "forecast")


def growth(shown: WorstForecast, time: str = "") -> str:
    """Draw how the error of the forecast over all sites grows, in units of the noise."""
    figure, axes = _axes()
    highest = 1.0
    for one, colour, style in ((shown.before, BEFORE, "--"), (shown.after, AFTER, "-")):
        if one is None:
            continue
        size = forecast_error(one, shown.moving, (1, 2), shown.noise)
        size = np.minimum(np.where(np.isfinite(size), size, np.nan), 1e6)
        axes.plot(*thinned(one.t, size), style, color=colour, linewidth=1.8)
        highest = max(highest, float(np.nanmax(size)) if np.any(np.isfinite(size)) else 1.0)
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--")
    axes.set_ylim(0, 1.08 * highest)
    axes.set_xlabel(axis("t", time))
    axes.set_ylabel("error / noise")
    return _svg(figure, "growth")
