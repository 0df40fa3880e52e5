"""Moving pictures of a chain: every site at its height, its readings as dots, and curves of equations as lines."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.bench.colours import AFTER, BEFORE, FAINT, INK
from latticebench.bench.escape import label
from latticebench.bench.overlay import Overlay
from latticebench.bench.provenance import lines
from latticebench.bench.report.units import axis, with_unit
from latticebench.systems.errors import InputError
from latticebench.systems.files import whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILMS = (".gif", ".mp4")
# Pictures that a film has at most, and how many are shown in a second.
FRAMES, PER_SECOND = 240, 20


def check_film(path: Path) -> None:
    """Make sure that a film can be written.

    Raises:
        InputError: MP4 is asked for, and there is no ffmpeg.
    """
    from matplotlib.animation import FFMpegWriter

    if path.suffix.lower() == ".mp4" and not FFMpegWriter.isAvailable():
        raise InputError(
            f"{path}: MP4 needs the program ffmpeg, which is not found; install it (package ffmpeg of Debian, Homebrew "
            "or conda-forge), or write a .gif"
        )


def animate(overlay: Overlay, path: Path, about: Mapping[str, Any]) -> None:
    """Write a film of a chain as GIF or MP4, by the ending of `path`.

    Args:
        overlay: what moves; of a long recording evenly chosen rows.
        path: the file.
        about: its provenance.

    Raises:
        InputError: the file cannot be written, or MP4 is asked for, and there is no ffmpeg.
    """
    from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
    from matplotlib.figure import Figure

    check_film(path)
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.add_subplot()
    rows = np.unique(np.linspace(0, len(overlay.t) - 1, min(len(overlay.t), FRAMES)).round().astype(int))
    place = np.arange(overlay.sites) + 1
    drawn = []
    for values, names, style in _moving(overlay):
        for part, name in enumerate(names):
            (line,) = axes.plot(
                place, values[0, part], label=label(name), **(style | ({"alpha": 0.45} if part else {}))
            )
            drawn.append((line, values[:, part]))
    _furnish(axes, overlay)
    # Places are the same in every picture, and finding them takes longer than drawing.
    axes.set_title("t", fontsize=10, loc="left")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")

    def show(row: int) -> list[Any]:
        for line, values in drawn:
            line.set_ydata(values[row])
        axes.set_title(label(with_unit(f"t = {overlay.t[row]:.4g}", overlay.time_unit)), fontsize=10, loc="left")
        return [line for line, _ in drawn]

    film = FuncAnimation(figure, show, frames=rows.tolist(), blit=False, cache_frame_data=False)
    kind = PillowWriter if path.suffix.lower() == ".gif" else FFMpegWriter
    with whole(path) as temporary:
        film.save(str(temporary), writer=kind(fps=PER_SECOND, metadata={"comment": "\n".join(lines(about))}), dpi=100)


def _moving(overlay: Overlay) -> list[tuple[np.ndarray, tuple[str, ...], dict[str, Any]]]:
    """Return what moves: values (T, parts, N), the names of their parts, and how they are drawn."""

    def named(name: str) -> tuple[str, ...]:
        return (f"{name}, Re u", f"{name}, Im u") if overlay.is_complex else (name,)

    colours = [BEFORE] * (len(overlay.curves) - 1) + [AFTER]
    found = [
        (values, named(name), {"color": colour, "lw": 1.6, "ls": "-" if colour == AFTER else "--"})
        for (name, values), colour in zip(overlay.curves.items(), colours, strict=False)
    ]
    dots = {"color": INK, "marker": "o", "ms": 6 if overlay.sites < 40 else 3, "ls": "" if found else "-", "lw": 0.8}
    return [*found, (overlay.seen, named("readings"), dots)]


def _furnish(axes: Axes, overlay: Overlay) -> None:
    """Give the axes their ends, names and legend."""
    from matplotlib.ticker import MaxNLocator

    seen = overlay.seen[np.isfinite(overlay.seen)]
    low, high = float(np.min(seen)), float(np.max(seen))
    room = 0.12 * (high - low or 1.0)
    axes.set_ylim(low - room, high + room)
    axes.set_xlim(0.5, overlay.sites + 0.5)
    axes.axhline(0.0, color=FAINT, lw=1, zorder=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("site")
    axes.set_ylabel(axis("u", overlay.unit))
    if overlay.curves or overlay.is_complex:
        axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
