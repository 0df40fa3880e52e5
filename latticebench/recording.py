"""A recording and the equation that is declared for it; `latticebench.front` has what is done with them."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import pandas as pd

from latticebench import systems
from latticebench.bench.calls import case_of
from latticebench.bench.effort import check_size
from latticebench.bench.fitting import samples as make_samples
from latticebench.bench.inspection import Inspection
from latticebench.bench.inspection import inspect as inspect_samples
from latticebench.bench.overlay import of_recording
from latticebench.bench.report.inspected import SHOWN, extent, lines, more
from latticebench.bench.report.rows import html_table
from latticebench.bench.report.units import in_words, units_of
from latticebench.labelled import as_table, is_labelled
from latticebench.pictures import Film, Picture, Survey
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import Library, library
from latticebench.systems.layout import ALWAYS, Layout
from latticebench.systems.options import called_from_python
from latticebench.systems.readers import from_arrays, from_frame, read_all
from latticebench.systems.samples import Samples, check_alike, check_units
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    import xarray
    from numpy import ndarray
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Recording:
    """One or more trajectories, as `read` returns them.

    Attributes:
        samples: the trajectories.
    """

    samples: tuple[Samples, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """How the files were read, where that is not plain."""
        return tuple(dict.fromkeys(note for one in self.samples for note in one.origin.notes))

    def to_frame(self) -> pd.DataFrame:
        """Return times and readings, in the units of the equation, with a column `trajectory` where there are several.

        >>> import latticebench as lb
        >>> data = lb.read(([0.0, 0.1, 0.2], [[1.0, 2.0], [1.5, 2.5], [2.0, 3.0]]))
        >>> data.to_frame()
             t   u1   u2
        0  0.0  1.0  2.0
        1  0.1  1.5  2.5
        2  0.2  2.0  3.0
        """
        frames = []
        for number, one in enumerate(self.samples, 1):
            columns: dict[str, Any] = {"trajectory": number} if len(self.samples) > 1 else {}
            columns["t"] = one.t
            for letter, values in (("u", one.u), ("v", one.v), ("f", one.f)):
                if values is not None:
                    columns |= {f"{letter}{site + 1}": values[:, site] for site in range(one.sites)}
            frames.append(pd.DataFrame(columns))
        return pd.concat(frames, ignore_index=True)

    def plot(self, *only: str, trajectory: int = 1) -> Picture:
        """Draw the readings: a map of site against time, lines, spectrum, phase planes.

        Args:
            only: names of panels: map, sites, spectrum, phase; all if there are none.
            trajectory: which one, from 1.

        Raises:
            InputError: there is no such panel or trajectory.

        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 10, 50)
        >>> lb.read((t, np.cos(1.5 * t))).plot()
        Picture(arrays: all panels)
        """
        return Picture(of_recording(_one_of(self, trajectory)), only)

    def animate(self, trajectory: int = 1) -> Film:
        """Return a film of the chain, which a notebook shows and `save` writes.

        Raises:
            InputError: there is no such trajectory.

        >>> import latticebench as lb
        >>> lb.read(([0.0, 0.1, 0.2], [[1.0, 2.0], [1.5, 2.5], [2.0, 3.0]])).animate()
        Film(arrays: 2 sites, 3 rows)
        """
        return Film(of_recording(_one_of(self, trajectory)))

    @called_from_python
    def inspect(self, model: Model | None = None) -> Inspected:
        """Return what the recording is like, and what is suspicious; with a model, whether it makes sense in that."""
        library = None if model is None else model.library
        return Inspected(self, tuple(inspect_samples(one, library) for one in self.samples))

    def __repr__(self) -> str:
        first, units = self.samples[0], in_words(units_of(self.samples[0].origin))
        rows = sum(len(one.t) for one in self.samples)
        parts = [f"{first.source}: {extent(first.sites, rows)}", f"{len(self.samples)} trajectories"]
        parts = [*parts[: 1 + (len(self.samples) > 1)], *([units] if units else []), *self.notes]
        return f"Recording({'; '.join(parts)})"

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self))}</p>{html_table(self.to_frame().head())}"


@called_from_python
def read(
    source: str
    | Path
    | Sequence[str | Path]
    | pd.DataFrame
    | xarray.DataArray
    | xarray.Dataset
    | tuple[ArrayLike, ArrayLike]
    | ndarray,
    *,
    time: str | ArrayLike | None = None,
    columns: str | Sequence[str] = (),
    scale: str | float = 1.0,
    sort: bool = False,
    turn: float = 0.0,
    time_scale: str | float = 1.0,
    between: tuple[float, float] = ALWAYS,
) -> Recording:
    """Read a recording.

    Args:
        source: a file (.csv, .txt, .tsv, .dat, .xlsx, .parquet, .npz) or several; a DataFrame; an xarray.DataArray of
            time and site, or a Dataset of such; an array of readings (T, sites) with its times as `time`; or both
            arrays as a pair.
        time: the column of the times; "t" if not given. In xarray's objects the dimension; "time" or "t". For an array
            of readings, the times (T,).
        columns: the columns of u by site: a pattern such as "theta_*_deg", or names; u1, u2, ... if not given. In a
            Dataset also the variable.
        scale: what one unit of a reading is in the equation: a number, or the unit of the readings such as "deg".
        sort: sort rows by their times, and average rows of the same time.
        turn: unwrap angles that jump back after a full turn. It is a full turn in the unit of the file, such as 360;
            neighbouring readings must be less than half of it apart. 0 leaves u as it is. v is never changed.
        time_scale: what one unit of the times is in the equation: a number, or the unit of the times such as "ms",
            which become seconds. v, the change of u in one unit of the times, is divided by it.
        between: the first and the last time that are read, in the unit of the file.

    Raises:
        InputError: it cannot be read; the message says where, and what would read it.

    Examples:
        >>> import latticebench as lb
        >>> import pandas as pd
        >>> table = pd.DataFrame({"time_s": [0.0, 0.1], "theta_1_deg": [0.0, 90.0], "remark": ["a", "b"]})
        >>> data = lb.read(table, time="time_s", columns="theta_*_deg", scale="deg")
        >>> data.to_frame().round(3)
             t     u1
        0  0.0  0.000
        1  0.1  1.571
        >>> data.notes[-1]
        'not read: remark'
        >>> import numpy as np
        >>> t = np.linspace(0, 1, 3)
        >>> lb.read(np.cos(t), time=t)
        Recording(arrays: 1 site, 3 rows)
    """
    chosen = (columns,) if isinstance(columns, str) else tuple(columns)
    if time is not None and not isinstance(time, str):
        source, time = _with_times(source, time), None
    layout = Layout(time, chosen, str(scale), sort, turn, str(time_scale), between)
    if is_labelled(source):
        table, layout = as_table(source, layout)
        return Recording(tuple(from_frame(table, type(source).__name__, "unknown", layout)))
    if isinstance(source, pd.DataFrame):
        return Recording(tuple(from_frame(source, "table", "unknown", layout)))
    if isinstance(source, tuple) and len(source) == 2 and not isinstance(source[0], (str, Path)):
        t, u = cast("tuple[ArrayLike, ArrayLike]", source)
        return Recording(tuple(from_arrays(t, u, "arrays", "unknown", layout)))
    if not isinstance(source, (str, Path)) and (
        hasattr(source, "dtype")
        or not isinstance(source, Sequence)
        or not all(isinstance(one, (str, Path)) for one in source)
    ):
        kind = type(source).__name__
        raise InputError(f"{kind}: give an array with its times, lb.read(u, time=t), a table, or the name of a file")
    paths = [source] if isinstance(source, (str, Path)) else list(cast("Sequence[str | Path]", source))
    return Recording(tuple(read_all([Path(str(one)) for one in paths], "unknown", layout)))


def _with_times(source: Any, time: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
    """Return times and readings as a pair.

    Raises:
        InputError: the readings are no array.
    """
    named = isinstance(source, (str, Path, pd.DataFrame, tuple)) or is_labelled(source)
    if named or any(isinstance(one, (str, Path)) for one in source):
        raise InputError(
            "time: an array of times belongs to an array of readings, as in lb.read(u, time=t); elsewhere it is the "
            "name of a column"
        )
    return time, source


def _one_of(data: Recording, trajectory: int) -> Samples:
    """Return a trajectory, counted from 1.

    Raises:
        InputError: there is no such one.
    """
    if not 1 <= trajectory <= len(data.samples):
        raise InputError(f"trajectory {trajectory}: {data.samples[0].source} has {len(data.samples)}")
    return data.samples[trajectory - 1]


@dataclass(frozen=True, eq=False)
class Inspected:
    """What a recording is like before any equation.

    Attributes:
        data: the recording.
        trajectories: what each trajectory is like (`latticebench.bench.inspection.Inspection`).

    >>> import latticebench as lb
    >>> import numpy as np
    >>> t = np.arange(0, 20, 0.1)
    >>> u = np.stack([np.cos(3 * t), np.full(200, 0.5)], axis=1)
    >>> seen = lb.read((t, u)).inspect()
    >>> seen.suspicious
    ('u2: always 0.5; does this sensor work?',)
    >>> seen.table["readings"].tolist()
    [200, 200]
    """

    data: Recording
    trajectories: tuple[Inspection, ...]

    @property
    def suspicious(self) -> tuple[str, ...]:
        """What deserves a look, one sentence each; of several trajectories it begins with where it was seen."""
        several = len(self.trajectories) > 1
        lines = (
            line if not several or line.startswith(f"{one.source}: ") else f"{one.source}: {line}"
            for one in self.trajectories
            for line in one.suspicious
        )
        return tuple(dict.fromkeys(lines))

    @property
    def table(self) -> pd.DataFrame:
        """Each sensor of each trajectory: its column, readings, range, noise and converter step, in the file's unit."""
        rows = [
            {"trajectory": number, "site": site, **vars(sensor)}
            for number, one in enumerate(self.trajectories, 1)
            for site, sensor in enumerate(one.sensors, 1)
        ]
        frame = pd.DataFrame(rows).rename(columns={"name": "column"})
        return frame if len(self.trajectories) > 1 else frame.drop(columns="trajectory")

    def plot(self, trajectory: int = 1) -> Survey:
        """Draw the readings of every sensor, one above the other, and their spectrum.

        Args:
            trajectory: which one, from 1.

        Raises:
            InputError: there is no such trajectory.
        """
        return Survey(_one_of(self.data, trajectory))

    def _lines(self) -> list[str]:
        suspicious = self.suspicious
        told = [f"Suspicious: {line}" for line in suspicious[:SHOWN]] or ["Nothing suspicious."]
        told += more(suspicious, "in `.suspicious`")
        for one, samples in list(zip(self.trajectories, self.data.samples, strict=True))[:SHOWN]:
            told += [one.source, *one.notes, *lines(one, samples.origin.time)]
        return [*told, *more(self.trajectories, "in `.trajectories`")]

    def __repr__(self) -> str:
        table = self.table
        return "\n".join([*self._lines(), table[:SHOWN].to_string(index=False), *more(table, "in `.table`")])

    def _repr_html_(self) -> str:
        table = self.table
        left = "".join(f"<p>{line}</p>" for line in more(table, "in `.table`"))
        return f"<p>{'<br>'.join(map(html.escape, self._lines()))}</p>{html_table(table[:SHOWN])}{left}"


@dataclass(frozen=True)
class Model:
    """An equation of motion with free coefficients.

    Attributes:
        terms: the terms, with ; between them.
        order: of the time derivative, 1 or 2.
        ends: how the chain ends: unknown, free, fixed, periodic or antiperiodic.

    >>> import latticebench as lb
    >>> lb.Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
    Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
    """

    terms: str
    order: Literal[1, 2] = 2
    ends: Ends = "unknown"

    def __post_init__(self) -> None:
        """Refuse what is no model, before there are data."""
        if not isinstance(self.terms, str):
            raise InputError(f"a model has its terms in one text with ; between them, not {type(self.terms).__name__}")
        if self.order not in (1, 2):
            raise InputError(f"order={self.order!r}: the order of the time derivative is 1 or 2")
        if self.ends not in get_args(Ends):
            raise unknown("ends", str(self.ends), get_args(Ends))
        _ = self.library

    @classmethod
    def checked(cls, model: Model) -> Model:
        """Return a model.

        Raises:
            InputError: it is something else.
        """
        if not isinstance(model, cls):
            raise InputError(f"a model is made by lb.Model('u[n]', order=2), say; this is {type(model).__name__}")
        return model

    @property
    def library(self) -> Library:
        """The terms, read."""
        return library("terms", self.terms)

    def of(self, data: Recording) -> list[Samples]:
        """Return recordings with the ends of this model.

        Raises:
            InputError: it is no recording, or trajectories differ in their sites, columns or units.
        """
        if not isinstance(data, Recording):
            raise InputError(f"a recording is what lb.read(...) returns, not {type(data).__name__}")
        found = [replace(one, ends=self.ends) for one in data.samples]
        check_alike(found)
        check_units(found)
        return found

    def __repr__(self) -> str:
        return f'Model("{self.terms}", order={self.order}, ends="{self.ends}")'

    def _repr_html_(self) -> str:
        left = "u" + "'" * self.order
        right = " + ".join(f"c{k} ({text})" for k, text in enumerate(self.library.texts, 1))
        return f"<p><code>{html.escape(f'{left} = {right}')}</code>; ends {self.ends}</p>"


def system(name: str, library: str = "equation") -> Model:
    """Return the equation of a system, or one of its libraries, as a model.

    >>> import latticebench as lb
    >>> lb.system("phi4")
    Model("u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3", order=2, ends="free")
    """
    found = systems.find(name)
    return Model("; ".join(found.library(library).texts), found.order, found.ends)


# What may be said of a simulation besides its system, and what has no bound on its size.
OBSERVED = (
    "sites", "samples", "span", "uneven", "noise", "missing", "velocities", "trajectories", "ends", "initial",
    "integrator", "seed",
)  # fmt: skip
UNBOUNDED = "latticebench.systems.simulate.simulate has no limits"


@called_from_python
def simulate(name: str, parameters: Mapping[str, float] | None = None, **observed: Any) -> Recording:
    """Return a simulated recording of a system, as `latticebench simulate` writes it; all is dimensionless.

    Args:
        name: of the system, or a file with one.
        parameters: of the system, by name; the others are its own.
        **observed: how it is observed, each with what it is otherwise: `sites` and `ends` (the system's own), `initial`
            (the state it starts from; the system's first), `samples` (50) and `span` (10): times are 0, span / samples,
            ...; `uneven` (False) draws them at random; `noise` (0) is sigma over the RMS of the field about its mean,
            `missing` (0) the share of lost values; `velocities` (True) are given where the system is of second order;
            `trajectories` (1), each further one from another state; `integrator` (the system's own) is rk4, bdf or
            dop853; `seed` (1) of all that is drawn.

    Raises:
        InputError: there is no such system, parameter, state or argument, or a number is out of its range.

    Examples:
        >>> import latticebench as lb
        >>> data = lb.simulate("phi4", {"C": 2.0, "v": 0.5}, sites=9, samples=60, noise=0.01)
        >>> data
        Recording(simulated samples: 9 sites, 60 rows)
        >>> lb.fit(data, lb.system("phi4")).table["coefficient"].round(1).tolist()
        [2.0, 2.0, -2.0]
    """
    for given in observed:
        if given not in OBSERVED:
            raise unknown("argument", given, OBSERVED, "simulate")
    case = case_of(system=name, parameters=dict(parameters or {}), **observed)
    check_size(case, case.sites or systems.find(name).sites, name, UNBOUNDED)
    return Recording(tuple(one.observed() for one in make_samples(case, Path())))
