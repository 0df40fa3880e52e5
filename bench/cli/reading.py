"""How recordings are read: options that every command with files has, and what is said of the reading."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import AnyEnds, named, place
from latticebench.systems.errors import printable

if TYPE_CHECKING:
    from latticebench.systems.layout import Layout
    from latticebench.systems.samples import Samples

PANEL = "How the recording lies in its file"
Files = Annotated[
    list[Path],
    typer.Argument(
        parser=place, metavar="FILES...",
        help="One or more .csv, .txt, .tsv, .dat, .xlsx, .parquet or .npz files, or folders of such, or .zarr.",
    ),
]  # fmt: skip
Time = Annotated[
    str | None,
    typer.Option(
        parser=named, metavar="COLUMN", rich_help_panel=PANEL, help="The column of the times; t if not given."
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAMES", rich_help_panel=PANEL,
        help='The columns of u by site: a pattern such as "theta_*_deg", or names with commas between them; '
        "u1, u2, ... if not given.",
    ),
]  # fmt: skip
Scale = Annotated[
    str,
    typer.Option(
        metavar="NUMBER|UNIT", rich_help_panel=PANEL,
        help="What one unit of a reading is in the equation: a number such as 1e-3, or the unit, such as deg or mm, "
        "which becomes rad or m.",
    ),
]  # fmt: skip
Sort = Annotated[
    bool,
    typer.Option("--sort", rich_help_panel=PANEL, help="Sort rows by their times, and average rows of the same time."),
]

Turn = Annotated[
    float,
    typer.Option(
        "--turn", metavar="NUMBER", rich_help_panel=PANEL,
        help="Unwrap angles that jump back after a full turn. NUMBER is a full turn in the unit of the file, such as "
        "360; neighbouring readings must be less than half of it apart. v is not changed.",
    ),
]  # fmt: skip
TimeScale = Annotated[
    str,
    typer.Option(
        "--time-scale", metavar="NUMBER|UNIT", rich_help_panel=PANEL,
        help="What one unit of the times is in the equation: a number, or the unit, such as ms, which becomes s. "
        "v is divided by it.",
    ),
]  # fmt: skip
Between = Annotated[
    tuple[float, float] | None,
    typer.Option(
        "--between", metavar="TIME TIME", rich_help_panel=PANEL, show_default=False,
        help="Read no other times than these, in the unit of the file; inf for the last one leaves out the beginning "
        "alone.",
    ),
]  # fmt: skip


def layout_of(
    time: str | None = None,
    columns: Sequence[str] | None = None,
    scale: str = "1",
    sort: bool = False,
    turn: float = 0.0,
    time_scale: str = "1",
    between: tuple[float, float] | None = None,
) -> Layout:
    """Return the layout that the options describe.

    Raises:
        InputError: a scale is neither a number nor a unit, the turn is none, or no time is to be read.
    """
    from latticebench.systems.layout import ALWAYS, Layout

    layout = Layout(time, tuple(columns or ()), scale, sort, turn, time_scale, between or ALWAYS)
    _ = layout.factor, layout.period, layout.time_factor, layout.stretch
    return layout


def read_told(files: Sequence[Path], ends: AnyEnds, layout: Layout) -> list[Samples]:
    """Return the recordings of files, and say on standard error how they were read where that is not plain.

    Raises:
        InputError: a file is invalid, or two of them differ.
    """
    from latticebench.systems.readers import read_all

    data = read_all(files, ends, layout)
    say_notes(data)
    return data


def say_notes(data: Sequence[Samples]) -> None:
    """Say on standard error how recordings were read; trajectories of one file have the same to be said."""
    for line in dict.fromkeys(
        f"{one.source.partition(', trajectory ')[0]}: {'; '.join(one.origin.notes)}" for one in data if one.origin.notes
    ):
        print(printable(line), file=sys.stderr)
