"""What is said and drawn of a recording before any equation, on the terminal and in a notebook."""

from __future__ import annotations

from collections.abc import Sized
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.colours import INK
from latticebench.bench.escape import label
from latticebench.bench.inspection import Inspection
from latticebench.bench.plots import in_decades
from latticebench.bench.report.rows import Table
from latticebench.bench.report.units import axis, rate_of, with_unit
from latticebench.diagnosis.spectrum import Spectrum
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIELDS = {"v": "velocities", "f": "an input"}
# Sensors whose names are written at an axis, at most.
NAMED = 20
# Suspicions, sensors and trajectories that people are shown.
SHOWN = 200


def extent(sites: int, rows: int) -> str:
    """Return the size of a recording in words."""
    return f"{sites} site{'s' if sites > 1 else ''}, {rows} row{'s' if rows > 1 else ''}"


def more(every: Sized, where: str) -> list[str]:
    """Return a line that counts those beyond the `SHOWN` first and says where they are; none where all are shown."""
    return [f"{len(every) - SHOWN} more {where}"] if len(every) > SHOWN else []


def lines(found: Inspection, time: str) -> list[str]:
    """Return sites, times, gaps and frequencies in words; `time` is the unit of the times."""
    seen = f", with {' and '.join(FIELDS[one] for one in found.seen)}" if found.seen else ""
    span = f"t = {found.begin:g} to {found.end:g} {time}".rstrip()
    every = f"every {found.interval:.4g} {time}".rstrip() + (", unevenly" if found.uneven else "")
    cycles, angular = (", ".join(f"{by * one:.4g}" for one in found.frequencies) for by in (1, 2 * np.pi))
    told = f"{with_unit(angular, rate_of('rad', time))} ({cycles} cycles per {time or 'unit of time'})"
    return [
        f"{extent(found.sites, found.rows)}{seen}; {span}, {every}",
        *(f"gap from t = {begin:g} to {end:g}" for begin, end in found.gaps),
        f"main angular frequencies: {told if cycles else 'none stands out'}",
    ]


def sensors(found: Inspection, unit: str) -> Table:
    """Return range, noise and steps of each sensor; `unit` is that of the readings."""
    rows = [
        [
            str(site), one.name, str(one.readings), str(one.missing), f"{one.least:.4g}", f"{one.most:.4g}",
            "not seen" if np.isnan(one.noise) else f"{one.noise:.2g}", f"{one.step:.3g}" if one.step else "-",
        ]
        for site, one in enumerate(found.sensors, 1)
    ]  # fmt: skip
    inside = f" ({unit})" if unit else ""
    return [
        "site",
        "column",
        "readings",
        "missing",
        f"least{inside}",
        f"most{inside}",
        f"noise{inside}",
        f"steps{inside}",
    ], rows


def picture(samples: Samples, figure: Figure | None = None) -> Figure:
    """Draw the readings of every sensor, one above the other, and their spectrum.

    Args:
        samples: whose readings.
        figure: to draw on, such as one of pyplot's; it gets the size that this needs. None for a new one.
    """
    from matplotlib.figure import Figure

    origin = samples.origin
    values = split_parts(samples.u, samples.is_complex)[:, 0] / origin.scale
    figure = Figure() if figure is None else figure
    figure.set_size_inches(9, 5)
    figure.set_layout_engine("constrained")
    readings, powers = figure.subplots(1, 2, width_ratios=(2, 1))
    middle = np.nanmean(values, axis=0)
    spacing = 1.1 * float(np.nanmax(np.abs(values - middle))) or 1.0
    readings.plot(samples.t, values - middle + spacing * np.arange(samples.sites), color=INK, linewidth=0.8)
    names = [label(one) for one in origin.columns] or [f"u{site + 1}" for site in range(samples.sites)]
    every = max(1, samples.sites // NAMED)
    readings.set_yticks(spacing * np.arange(samples.sites)[::every], names[::every])
    readings.set_xlabel(axis("t", origin.time))
    apart = label(with_unit(f"{spacing:.2g}", origin.unit))
    readings.set_title(f"readings about their means; {apart} from one to the next")
    spectrum = Spectrum.of(samples)
    powers.plot(spectrum.omega, spectrum.power, color=INK, linewidth=0.8)
    if in_decades(powers):
        top = float(np.max(spectrum.power))
        powers.set_ylim(1e-8 * top, 2 * top)
    powers.set_xlabel(axis("angular frequency", rate_of("rad", origin.time)))
    powers.set_title("mean power spectrum")
    return figure
