"""The picture of mean ranks: methods on a line, and bars over those that are not told apart (Demsar 2006)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from latticebench.bench.against import Ranks
from latticebench.bench.colours import INK, series
from latticebench.bench.escape import label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def alike(mean: Sequence[float], distance: float) -> list[tuple[int, int]]:
    """Return the longest runs of neighbours whose mean ranks differ by less than `distance`, as first and last.

    Args:
        mean: in increasing order.
        distance: the critical difference.
    """
    runs: list[tuple[int, int]] = []
    for first, rank in enumerate(mean):
        last = max(k for k, other in enumerate(mean) if other - rank < distance)
        if last > first and (not runs or last > runs[-1][1]):
            runs.append((first, last))
    return runs


def draw_ranks(ranks: Ranks) -> Figure:
    """Draw mean ranks: the best on the left, names below with their ranks."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mean = [float(rank) for rank in ranks.mean]
    names = [label(str(name)) for name in ranks.mean.index]
    count = len(mean)
    bars = alike(mean, ranks.distance)
    half = -(-count // 2)
    depth = 0.5 + 0.22 * len(bars)
    figure, axes = plt.subplots(figsize=(7.0, 1.2 + 0.24 * (half + len(bars))), layout="constrained")
    axes.set_xlim(0.2 - 0.35 * count, count + 0.8 + 0.35 * count)
    axes.set_ylim(-depth - 0.4 * half, 1.4)
    axes.axis("off")
    axes.plot([1, count], [0, 0], color=INK, lw=1)
    for tick in range(1, count + 1):
        axes.plot([tick, tick], [0, 0.12], color=INK, lw=1)
        axes.text(tick, 0.18, str(tick), ha="center", va="bottom", fontsize=8)
    axes.plot([1, min(1 + ranks.distance, count + 0.8)], [0.9, 0.9], color=INK, lw=2)
    axes.text(1, 0.98, f"critical difference {ranks.distance:.2f}", ha="left", va="bottom", fontsize=8)
    for place, (rank, name) in enumerate(zip(mean, names, strict=True)):
        left = place < half
        level = -depth - 0.4 * (place if left else count - 1 - place)
        end = 0.8 if left else count + 0.2
        axes.plot([rank, rank, end], [0, level, level], color=series(place), lw=1)
        text, side = (f"{name}  {rank:.2f} ", "right") if left else (f" {rank:.2f}  {name}", "left")
        axes.text(end, level, text, ha=side, va="center", fontsize=8)
    for number, (first, last) in enumerate(bars):
        level = -0.25 - 0.22 * number
        axes.plot([mean[first] - 0.05, mean[last] + 0.05], [level, level], color=INK, lw=3, solid_capstyle="butt")
    axes.set_title(f"mean rank of E2 over {ranks.cases} cases (1 is the best)", fontsize=9)
    return figure
