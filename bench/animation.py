"""Moving pictures of a chain: every site at its height, its readings as dots, and curves of equations as lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
# Inches, and dots in each.
SIZE, DENSITY = (6.4, 3.8), 100


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
    check_film(path)
    with whole(path) as temporary:
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(
            list(_frames(overlay)), temporary, "\n".join(lines(about))
        )


def _frames(overlay: Overlay) -> Iterator[np.ndarray]:
    """Yield the pictures of a film (height, width, 3); what does not move is drawn once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DENSITY, layout="constrained")
    axes = figure.add_subplot()
    place = np.arange(overlay.sites) + 1
    drawn = []
    for values, names, style in _moving(overlay):
        for part, name in enumerate(names):
            (line,) = axes.plot(
                place, values[0, part], label=label(name), **(style | ({"alpha": 0.45} if part else {}))
            )
            drawn.append((line, values[:, part]))
    _furnish(axes, overlay)
    time = axes.set_title("t", fontsize=10, loc="left")
    for one in (time, *(line for line, _ in drawn)):
        one.set_animated(True)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    for row in np.unique(np.linspace(0, len(overlay.t) - 1, min(len(overlay.t), FRAMES)).round().astype(int)):
        canvas.restore_region(still)
        time.set_text(label(with_unit(f"t = {overlay.t[row]:.4g}", overlay.time_unit)))
        axes.draw_artist(time)
        for line, values in drawn:
            line.set_ydata(values[row])
            axes.draw_artist(line)
        yield np.array(canvas.buffer_rgba())[..., :3]


def _write_gif(frames: Sequence[np.ndarray], path: Path, comment: str) -> None:
    from PIL import Image

    # One palette for all, the commonest colours: finding one for each picture takes longer than drawing it.
    some = np.stack(frames[:: max(1, len(frames) // 16)]).astype(np.int32) @ (1 << 16, 1 << 8, 1)
    colours, counts = np.unique(some, return_counts=True)
    common = colours[np.argsort(-counts, kind="stable")[:256]]
    palette = Image.new("P", (1, 1))
    palette.putpalette([int(part) for one in common for part in (one >> 16, one >> 8 & 255, one & 255)])
    first, *others = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in frames)
    first.save(
        path, format="GIF", save_all=True, append_images=others, duration=1000 // PER_SECOND, loop=0,
        comment=comment.encode(),
    )  # fmt: skip


def _write_mp4(frames: Sequence[np.ndarray], path: Path, comment: str) -> None:
    from matplotlib.animation import FFMpegWriter
    from matplotlib.figure import Figure

    shown = Figure(figsize=SIZE, dpi=DENSITY)
    picture = shown.figimage(frames[0])
    writer = FFMpegWriter(fps=PER_SECOND, metadata={"comment": comment})
    with writer.saving(shown, str(path), DENSITY):
        for one in frames:
            picture.set_data(one)
            writer.grab_frame()


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
