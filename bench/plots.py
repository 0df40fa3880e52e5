"""Pictures of a recording, and of an equation beside it: maps in space and time, lines, spectra, phase portraits."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.colours import AFTER, BEFORE, FAINT, INK, MAP, series
from latticebench.bench.escape import label
from latticebench.bench.overlay import Overlay
from latticebench.bench.report.units import axis, rate_of
from latticebench.bench.report.whereabouts import spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from numpy import ndarray

# Chains shorter than this are drawn as lines: a map would have too few rows.
MAPPED = 4
# Sites with a line or a portrait of their own, and the samples that a line of readings with a fit has at most: a few
# periods, so that a curve is seen beside readings that it misses.
MOST_SITES, MOST_SAMPLES = 8, 100
WIDTH, HEIGHT = 5.6, 3.6
# Coefficients with a name beside their learning curves, and steps so few that each has a dot.
MOST_TERMS, FEW_STEPS = 8, 40
# Beyond so many times the range of the readings a curve has run away, and is not drawn.
FAR = 5.0
# A power below this counts as none.
LEAST = 1e-290


def plot(overlay: Overlay, only: Sequence[str] = (), *, titled: bool = True, figure: Figure | None = None) -> Figure:
    """Draw a recording, and the equations beside it if there are any.

    Args:
        overlay: what is drawn.
        only: panels, of `panels(overlay)`; all that tell something if none is given.
        titled: whether the source is written above.
        figure: to draw on, such as one of pyplot's; it gets the size that the panels need. None for a new one.
    """
    from matplotlib.figure import Figure

    drawn = panels(overlay)
    # Portraits tell little of an equation beside its readings.
    usual = [name for name in drawn if name != "phase" or not overlay.curves]
    chosen = [name for name in drawn if name in (only or usual)]
    across = min(len(chosen), 2)
    figure = Figure() if figure is None else figure
    figure.set_size_inches(WIDTH * across, HEIGHT * math.ceil(len(chosen) / across) + 0.3)
    figure.set_layout_engine("constrained")
    grid = figure.subfigures(math.ceil(len(chosen) / across), across, squeeze=False)
    for part, name in zip(grid.flat, chosen, strict=False):
        drawn[name](part, overlay)
    rows = "" if overlay.rows == len(overlay.t) else f", the first {len(overlay.t)} of {overlay.rows} rows"
    if titled:
        figure.suptitle(label(overlay.source) + rows, fontsize=10)
    return figure


def svg(overlay: Overlay, panel: str) -> str:
    """Draw a panel as an SVG element that is as wide as its place."""
    import matplotlib as mpl

    picture = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": panel}):
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        plot(overlay, [panel], titled=False).savefig(picture, format="svg", transparent=True, metadata=nothing, dpi=140)
    text = picture.getvalue()
    text = text[text.index("<svg ") :]
    head, _, rest = text.partition(">")
    kept = " ".join(word for word in head.split(" ") if not word.startswith(("width=", "height=", "version=")))
    return f"{kept}>{rest}"


def panels(overlay: Overlay) -> dict[str, Callable[[SubFigure, Overlay], None]]:
    """Return the panels that a picture may have, by name, each with what draws it."""
    every: dict[str, Callable[[SubFigure, Overlay], None]] = {"map": space_time, "sites": lines_of_sites}
    if overlay.curves:
        every["residual"] = residuals
    if overlay.learning is not None:
        every["learning"] = learning_curves
    return every | {"spectrum": spectra, "phase": portraits}


def space_time(part: SubFigure, overlay: Overlay) -> None:
    """Draw the readings, site against time; of a complex field its modulus."""
    name = axis("|u|" if overlay.is_complex else "u", overlay.unit)
    _map(part.subplots(), overlay, overlay.seen, name, centred=False)


def _map(
    axes: Axes, overlay: Overlay, values: ndarray, name: str, *, centred: bool, limit: float | None = None
) -> None:
    """Draw values (T, parts, N) in space and time; of complex ones the modulus."""
    t = overlay.t
    from matplotlib.ticker import MaxNLocator

    shown = values[:, 0] if values.shape[1] == 1 else np.hypot(values[:, 0], values[:, 1])
    middle = (t[1:] + t[:-1]) / 2
    edges = np.concatenate([[t[0] - (middle[0] - t[0])], middle, [t[-1] + (t[-1] - middle[-1])]])
    size = (limit or _size(shown)) if centred and values.shape[1] == 1 else None
    axes.set_facecolor(FAINT)
    drawn = axes.pcolormesh(
        edges, np.arange(shown.shape[1] + 1) + 0.5, shown.T, cmap=MAP, rasterized=True,
        vmin=None if size is None else -size, vmax=limit if size is None else size,
    )  # fmt: skip
    beyond = limit is not None and _size(shown) > limit
    extend = "neither" if not beyond else "max" if size is None else "both"
    axes.figure.colorbar(drawn, ax=axes, label=name, extend=extend)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(axis("t", overlay.time_unit))
    axes.set_ylabel("site")


def _size(values: ndarray) -> float:
    """Return the largest size of values that are known."""
    return float(np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values))) or 1.0


def lines_of_sites(part: SubFigure, overlay: Overlay) -> None:
    """Draw the readings of a few sites against time, with the curves on top; of a complex field its real part."""
    sites, rows = _telling(overlay)
    t, name = overlay.t[rows], "Re u" if overlay.is_complex else "u"
    every = part.subplots(len(sites), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    low, high = _range([overlay.seen[rows, 0][:, sites]])
    reach = high - low
    near = [np.clip(one[rows, 0][:, sites], low - reach, high + reach) for one in overlay.curves.values()]
    bottom, top = _range([np.array([low, high]), *near])
    every[0].set_ylim(bottom - 0.1 * reach, top + 0.1 * reach)
    crowded = len(sites) > 3
    if crowded:
        part.supylabel(axis(name, overlay.unit), fontsize=9)
    for axes, site in zip(every, sites, strict=True):
        style = {"marker": "o", "markersize": 2.2, "linestyle": "none" if overlay.curves else "-", "linewidth": 0.8}
        axes.plot(t, overlay.seen[rows, 0, site], color=INK, label="readings", **style)
        for curve, kind in _kinds(overlay.curves).items():
            values = overlay.curves[curve][rows, 0, site]
            known = np.abs(values - (low + high) / 2) < FAR * reach
            axes.plot(t, np.where(known, values, np.nan), label=label(curve), lw=1.4, **kind)
        axes.set_ylabel(f"site {site + 1}" if crowded else axis(f"{name} at site {site + 1}", overlay.unit), fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25)
    first = label(next(iter(overlay.curves), ""))
    part_of_it = f", the {len(t)} rows that {first!r} misses most" if len(t) < len(overlay.t) else ""
    every[-1].set_xlabel(axis("t", overlay.time_unit) + part_of_it + _of_all(sites, overlay))
    if overlay.curves:
        handles = every[0].get_legend_handles_labels()
        part.legend(*handles, loc="outside upper center", ncols=3, fontsize=8, frameon=False)


def _of_all(sites: Sequence[int], overlay: Overlay) -> str:
    """Say how many of the sites are drawn where not all are."""
    return f" ({len(sites)} of {overlay.sites} sites)" if len(sites) < overlay.sites else ""


def _range(fields: Sequence[ndarray]) -> tuple[float, float]:
    """Return the least and the largest of the values that are known, one unit apart where they are the same."""
    known = np.concatenate([one[np.isfinite(one)] for one in fields])
    low, high = (float(np.min(known)), float(np.max(known))) if len(known) else (0.0, 0.0)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _kinds(curves: Mapping[str, ndarray]) -> dict[str, dict[str, str]]:
    """Return how curves are drawn, by name: the last one is what was found, an earlier one what was declared."""
    names = list(curves)
    kinds = {name: {"color": BEFORE, "linestyle": "--"} for name in names[:-1]}
    return kinds | {name: {"color": AFTER, "linestyle": "-"} for name in names[-1:]}


def _telling(overlay: Overlay) -> tuple[list[int], slice]:
    """Return the sites and rows whose lines are drawn: those that move most, or that the first curve misses most."""
    if not overlay.curves:
        return overlay.moving(MOST_SITES), slice(None)
    left = np.nan_to_num(overlay.residual(next(iter(overlay.curves))) ** 2, posinf=0.0).sum(axis=1)
    count = min(len(left), MOST_SAMPLES)
    total = np.concatenate([[0.0], np.cumsum(left.sum(axis=1))])
    begin = int(np.argmax(total[count:] - total[:-count]))
    if overlay.sites <= MOST_SITES:
        return list(range(overlay.sites)), slice(begin, begin + count)
    worst = np.argsort(-left.sum(axis=0), kind="stable")[: MOST_SITES // 2].tolist()
    return sorted({*worst, *overlay.moving(MOST_SITES - 1 - len(worst))}), slice(begin, begin + count)


def residuals(part: SubFigure, overlay: Overlay) -> None:
    """Draw what each curve leaves of the readings, on one scale: as maps, or for a few sites as lines."""
    unit = "residual / noise" if overlay.noise is not None else axis("residual", overlay.unit)
    every = part.subplots(len(overlay.curves), 1, sharex=True, squeeze=False)[:, 0]
    left = {name: overlay.residual(name) for name in overlay.curves}
    known = np.concatenate([np.abs(one[np.isfinite(one)]) for one in left.values()])
    limit = float(np.quantile(known, 0.998)) if len(known) else 1.0
    for axes, (name, kind) in zip(every, _kinds(overlay.curves).items(), strict=True):
        if overlay.sites >= MAPPED:
            _map(axes, overlay, left[name], unit, centred=True, limit=limit)
        else:
            for site in range(overlay.sites):
                values = left[name][:, 0, site]
                colour = kind["color"] if overlay.sites == 1 else series(site)
                axes.plot(overlay.t, values, label=f"site {site + 1}", lw=0.8, color=colour)
            axes.set_ylabel(unit)
            axes.grid(alpha=0.25)
            if overlay.sites > 1:
                axes.legend(fontsize=7, ncols=overlay.sites, frameon=False, loc="upper right")
        axes.set_title(label(name), fontsize=9)
    for axes in every[:-1]:
        axes.set_xlabel("")
    every[-1].set_xlabel(axis("t", overlay.time_unit))


def spectra(part: SubFigure, overlay: Overlay) -> None:
    """Draw power spectra, the mean over the sites: of the residuals, or of the readings about their mean."""
    axes = part.subplots()
    if overlay.curves:
        for name, kind in _kinds(overlay.curves).items():
            omega, power, _ = spectrum(overlay.t, overlay.residual(name)[:, None])
            axes.plot(omega, power, label=label(name), lw=1.2, color=kind["color"], linestyle=kind["linestyle"])
        axes.set_ylabel("power of the residual" + (" / noise" if overlay.noise is not None else ""))
        if overlay.noise is not None:
            axes.axhline(1.0, color=INK, lw=0.8, ls=":", label="white noise")
        axes.legend(fontsize=8, frameon=False)
    else:
        omega, power, _ = spectrum(overlay.t, (overlay.seen - np.nanmean(overlay.seen, axis=0))[:, None])
        axes.plot(omega, power, color=INK, lw=1.2)
        axes.set_ylabel("power of the readings")
    in_decades(axes)
    axes.set_xlabel(axis("angular frequency", rate_of("rad", overlay.time_unit)))
    axes.grid(alpha=0.25)


def in_decades(axes: Axes) -> bool:
    """Give axes a logarithmic scale upwards if any line on them is above zero; return whether one is."""
    found = any(np.any(np.asarray(line.get_ydata()) > LEAST) for line in axes.get_lines())
    if found:
        axes.set_yscale("log")
    return found


def learning_curves(part: SubFigure, overlay: Overlay) -> None:
    """Draw the method's objective and the coefficients on the way to the fit, the largest of them with a name."""
    assert overlay.learning is not None
    terms, way = overlay.learning.terms, overlay.learning.history
    above, below = part.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    above.plot(way.step, way.loss, color=INK, lw=1.2, marker="." if len(way.step) < FEW_STEPS else "")
    in_decades(above)
    above.set_ylabel("objective", fontsize=8)
    last = way.coefficients[-1]
    largest = np.argsort(-np.abs(last), kind="stable")
    for term in largest[MOST_TERMS:]:
        below.plot(way.step, way.coefficients[:, term], color=FAINT, lw=0.8)
    # Neighbours in value, which may hide each other, differ in their dashes.
    for place, term in enumerate(sorted(largest[:MOST_TERMS], key=lambda term: -last[term])):
        below.plot(
            way.step, way.coefficients[:, term], color=series(place), lw=1.6, ls=("-", (0, (3, 3)))[place % 2],
            label=label(terms[term]),
        )  # fmt: skip
    low, high = _range([way.coefficients[-1], np.zeros(1)])
    below.set_ylim(low - 0.4 * (high - low), high + 0.4 * (high - low))
    below.set_ylabel("coefficient", fontsize=8)
    below.set_xlabel("step")
    for axes in (above, below):
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25)
    part.legend(*below.get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=7, frameon=False)


def portraits(part: SubFigure, overlay: Overlay) -> None:
    """Draw the readings of a few sites in their phase plane: velocity against u, or Im u against Re u."""
    sites = overlay.moving(MOST_SITES)
    across = min(len(sites), 3)
    every = part.subplots(math.ceil(len(sites) / across), across, sharex=True, sharey=True, squeeze=False)
    rates = None if overlay.is_complex else overlay.rates()
    for axes, site in zip(every.flat, sites, strict=False):
        x = overlay.seen[:, 0, site]
        y = overlay.seen[:, 1, site] if rates is None else rates[:, 0, site]
        axes.plot(x, y, color=AFTER, lw=0.7)
        axes.plot(x[:1], y[:1], "o", color=BEFORE, ms=4)
        axes.set_title(f"site {site + 1}", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25)
    for axes in list(every.flat)[len(sites) :]:
        axes.set_visible(False)
    part.supxlabel(axis("Re u" if rates is None else "u", overlay.unit) + _of_all(sites, overlay), fontsize=9)
    if rates is None:
        name = axis("Im u", overlay.unit)
    else:
        name = axis("slope of u" if overlay.velocity is None else "v", rate_of(overlay.unit, overlay.time_unit))
    part.supylabel(name, fontsize=9)
