"""What is done with a recording and a model in a notebook; see `latticebench` for the list of names.

    import latticebench as lb

    data = lb.read("pendula.csv", time="time_s", columns="theta_*_deg", scale="deg")
    model = lb.Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
    fit = lb.fit(data, model)
    cause = lb.diagnose(data, model)

Results show themselves in a notebook as tables or pages; tables are pandas DataFrames.
"""

from __future__ import annotations

import functools
import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from latticebench.bench import calls
from latticebench.bench.overlay import of_diagnosis
from latticebench.bench.report.rows import html_table
from latticebench.diagnosis.cure import Cure, corrected, cure, staying
from latticebench.diagnosis.instrument import without
from latticebench.exhibit import Exhibit
from latticebench.pictures import FROM_PYTHON
from latticebench.recording import Model, Recording
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.options import called_from_python

if TYPE_CHECKING:
    from latticebench.bench.limit import Design, Limit
    from latticebench.bench.overlay import Overlay
    from latticebench.bench.report.content import Report
    from latticebench.diagnosis.repair import Diagnosis


@dataclass(frozen=True, eq=False)
class Cause(Exhibit):
    """A diagnosis: what an equation lacks of a recording.

    Attributes:
        result: all that is known (`latticebench.diagnosis.repair.Diagnosis`).
        report: what is said of it.
        declared: the equation that was examined.
        recording: the recording that it was examined on.

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.arange(0, 20, 0.1)
        >>> noise = 0.001 * np.random.default_rng(1).standard_normal(len(t))
        >>> data = lb.read((t, 0.1 * np.exp(-0.05 * t) * np.cos(2 * t) + noise))
        >>> cause = lb.diagnose(data, lb.Model("u[n]", ends="free"))
        >>> cause.verdict
        'explained'
        >>> cause.model
        Model("u[n]; v[n]", order=2, ends="free")
        >>> again = lb.fit(cause.corrected, cause.model)
        >>> round(float(again.table.loc["v[n]", "coefficient"]), 2)
        -0.1
        >>> cause.plot("sites")
        Picture(arrays: sites)
    """

    result: Diagnosis
    report: Report
    declared: Model
    recording: Recording

    @property
    def verdict(self) -> str:
        """The verdict: "nothing missing", "explained", "partly explained" or "unexplained"."""
        return self.report.verdict

    @property
    def effects(self) -> pd.DataFrame:
        """Each number of each effect that was found, with its standard error and unit."""
        rows = [
            (one.effect, one.parameters.get("site"), name, size.value, size.stderr, size.unit)
            for one in self.report.effects
            for name, size in one.natural.items()
        ]
        return pd.DataFrame(rows, columns=["effect", "site", "what", "value", "standard error", "unit"])

    @property
    def errors(self) -> pd.DataFrame:
        """Errors before and after."""
        from latticebench.bench.report import rows

        columns, body = rows.errors(self.report)
        return pd.DataFrame(body, columns=columns)

    @functools.cached_property
    def _cure(self) -> Cure:
        return cure(self.result.after.model, self.result.after.chain)

    @property
    def model(self) -> Model:
        """The declared terms and those found, to be fitted again to `corrected`.

        What acts at one site alone is a term that is 0 at the others; what has a frequency or a time of its own keeps
        it. What no term can say is in `left_out`.
        """
        return Model("; ".join(self._cure.terms), self.declared.order, self._cure.ends)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The effects that neither `model` nor `corrected` has: memory, a clock, a zero that wanders.

        Without velocities what makes readings late is one of them; so is what does so by more than a sixth of a period.
        """
        unread = any(one.v is None for one in self.recording.samples)
        placed = [one.placed for one in self.result.findings]
        instruments = [one for one in placed if one.instrument]
        return (*self._cure.left_out, *(one.effect.name for one in staying(instruments, velocities=not unread)))

    @functools.cached_property
    def corrected(self) -> Recording:
        """The recording as it would read without what was found of its sensors: offsets, factors, crosstalk, lags.

        What makes readings late stays where no velocities were read, see `left_out`. Where a clock jumps, times are
        others than in the file. A sensor that always reads the same has no readings in it.
        """
        model, dead = self.result.after.model, self.result.dead
        return Recording(tuple(corrected(model, without(one, dead), k) for k, one in enumerate(self.recording.samples)))

    @property
    def elsewhere(self) -> tuple[str, ...]:
        """What acts at single sites, at the ends and on the readings, one sentence each."""
        return self.report.equation.after.elsewhere

    @property
    def page(self) -> str:
        """The page, as HTML."""
        from latticebench.bench.report.curves import curves
        from latticebench.bench.report.page import page

        return page(self.report, curves(self.result), overlay=self.overlay)

    @functools.cached_property
    def overlay(self) -> Overlay:
        """Readings and what both equations make of them (`latticebench.bench.overlay.Overlay`)."""
        return of_diagnosis(self.result)

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all."""
        from latticebench.systems.files import write_text

        write_text(Path(path), self.page)
        return Path(path)

    def __repr__(self) -> str:
        lines = [self.report.sentence, self.report.equation.after.text]
        lines += [f"    {line}" for line in self.elsewhere]
        left_out = f"; without {', '.join(self.left_out)}" if self.left_out else ""
        again = [f"to fit it again: lb.fit(cause.corrected, cause.model){left_out}"] if self.report.effects else []
        return "\n".join([*lines, *again])

    def _repr_html_(self) -> str:
        # In a frame, so that the page's styles stay its own.
        return f'<iframe srcdoc="{html.escape(self.page)}" style="width:100%;height:40em;border:0"></iframe>'


@called_from_python
def diagnose(
    data: Recording, model: Model, *, effects: str | Path | None = None, holdout: Recording | None = None
) -> Cause:
    """Find what a declared equation lacks of a recording; when interrupted, return what is known by then.

    Args:
        data: the recording.
        model: the declared equation.
        effects: a .toml file with effects of your own, tried beside the catalogue.
        holdout: a recording of the same chain to judge forecasts on; the last 30 % of `data` if not given.

    Returns:
        what was found; see `Cause` for an example.

    Raises:
        InputError: the equation cannot be set up on it, or the two recordings are not of the same chain or not in the
            same units.
    """
    count = len(Model.checked(model).of(data))
    every = model.of(data if holdout is None else Recording((*data.samples, *holdout.samples)))
    found, report = calls.diagnose(
        every[:count], model.library, model.order, effects=None if effects is None else Path(effects),
        later=every[count:],
    )  # fmt: skip
    return Cause(found, report, model, data)


@dataclass(frozen=True, eq=False)
class Bound:
    """How well any method could know the coefficients from a recording.

    Attributes:
        result: the bound (`latticebench.bench.limit.Limit`).
        needed: what a smaller error needs.
        notes: where it is taken, and the noise of each sensor.
        warnings: why it may not hold.
        units: of the coefficients; empty where none is known.

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.arange(0, 30, 0.1)
        >>> noise = 0.001 * np.random.default_rng(1).standard_normal(len(t))
        >>> bound = lb.limit(lb.read((t, 0.1 * np.cos(2 * t) + noise)), lb.Model("u[n]", ends="free"))
        >>> list(bound.table.columns)
        ['coefficient', 'smallest error', 'verdict']
        >>> bool(bound.table.loc["u[n]", "smallest error"] < 0.01)
        True
        >>> bound.needed.records
        1
    """

    result: Limit
    needed: Design
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = field(default=())
    units: tuple[str, ...] = field(default=())

    @property
    def table(self) -> pd.DataFrame:
        """Each term's coefficient, smallest standard error, unit where one is known, and verdict."""
        one, unit = self.result, {"unit": self.units} if self.units else {}
        columns = {"coefficient": one.coefficients, "smallest error": one.stderr, **unit, "verdict": one.verdicts}
        return pd.DataFrame(columns, index=pd.Index(one.library.texts, name="term"))

    def __repr__(self) -> str:
        return "\n".join([*(f"Warning: {line}." for line in self.warnings), self.table.to_string(), *self.notes])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p><b>Warning:</b> {html.escape(line)}.</p>" for line in self.warnings)
        return f"{lines}{html_table(self.table, index=True)}<p>{'<br>'.join(map(html.escape, self.notes))}</p>"


@called_from_python
def limit(data: Recording, model: Model, target: float = 0.01) -> Bound:
    """Return how well any method could know a model's coefficients from a recording.

    Args:
        data: the recording.
        model: the equation.
        target: a relative error of the coefficients; `needed` says what it takes.

    Returns:
        the bound; see `Bound` for an example.

    Raises:
        InputError: the equation cannot be set up on the recording.
    """
    from latticebench.bench.limit import design

    found = calls.bound(Model.checked(model).of(data), model.library, model.order)
    needed = design(found.at, target=target)
    return Bound(found.at(1, 1), needed, tuple(found.note.splitlines()), tuple(found.warnings), found.units)


class Tables(dict[str, pd.DataFrame]):
    """Published tables by name; see `results` for an example."""

    def __repr__(self) -> str:
        return f"Tables({', '.join(f'{name}: {len(frame)} rows' for name, frame in self.items())})"

    def _repr_html_(self) -> str:
        rows = [(name, len(frame), ", ".join(map(str, frame.columns))) for name, frame in self.items()]
        return html_table(pd.DataFrame(rows, columns=["table", "rows", "columns"]))


def results(name: str | Path) -> Tables:
    """Return the tables of a published run, or of a folder with published tables, by name.

    Args:
        name: a folder; or the name of one in `results` of a copy of this project's repository.

    Raises:
        InputError: there are no tables.

    Examples:
        >>> import latticebench as lb
        >>> tables = lb.results("default")
        >>> tables
        Tables(cases: ... rows, coefficients: ... rows, errors: ... rows...)
        >>> tables["cases"]["e2"].dtype
        dtype('float64')
    """
    from latticebench.bench.published import folder_of, read_table, without_results

    folder = Path(name) if os.path.isdir(name) else folder_of(str(name))
    paths = sorted(folder.glob("*.csv"))
    if not paths and folder_of("").is_dir() and os.sep not in str(name):
        raise unknown("published run", str(name), {path.parent.name for path in folder_of("").glob("*/*.csv")})
    if not paths:
        raise InputError(
            f"{name}: there are no published tables; give a folder with .csv files of `latticebench table`"
            f"{without_results()}"
        )
    found = {path.stem: read_table(path) for path in paths}
    return Tables({key: frame.apply(_numbers) for key, frame in found.items()})


@dataclass(frozen=True, eq=False)
class Run:
    """The results of a suite.

    Attributes:
        folder: where they are kept.
        statuses: how many cases ended how.

    Examples:
        >>> import latticebench as lb
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = lb.run("tiny", only=["phi4 noise*"], methods=["zero"], folder=f"{folder}/mine")
        ...     table = found.table()
        >>> found
        Run(1 ok; kept in ...mine)
        >>> list(table["status"])
        ['ok']
    """

    folder: Path
    statuses: Mapping[str, int]

    def table(self) -> pd.DataFrame:
        """Return one row per case, as `latticebench table --out` publishes it: what was run, status, scores, seconds.

        What differs between the kinds of cases of a suite, fits and trials of the diagnosis, is empty where it has no
        meaning.
        """
        from latticebench.bench.kinds import rows
        from latticebench.bench.store import open_store

        found = pd.DataFrame(rows(open_store(self.folder)))
        last = [name for name in ("settings", "reason", "identity") if name in found]
        return found[[name for name in found if name not in last] + last]

    def __repr__(self) -> str:
        return (
            f"Run({', '.join(f'{count} {status}' for status, count in self.statuses.items())}; kept in {self.folder})"
        )

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self))}</p>{html_table(self.table())}"


@called_from_python
def run(
    suite: str | Path,
    *,
    only: str | Sequence[str] = (),
    methods: str | Path | Sequence[str | Path] = (),
    seeds: str | Sequence[int] | None = None,
    jobs: int = 1,
    folder: str | Path | None = None,
) -> Run:
    """Run a suite or a part of it, continuing where it was stopped.

    Args:
        suite: a name from `latticebench list suites`, or a .toml file.
        only: a pattern such as "phi4*", or several; cases whose title, part, system, library, method or effect is so.
        methods: in place of the suite's: one of its labels, a name from `latticebench list methods`, a .py file, or
            several of these.
        seeds: in place of the suite's, such as "1-5" or [1, 3, 7].
        jobs: worker processes.
        folder: where results are kept; runs/SUITE if not given.

    Raises:
        InputError: there is no such suite, it is unsound, or nothing in it is what was chosen.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = run("tiny", only=["phi4 noise*"], methods=["stlsq"], folder=folder)
        ...     table = found.table()
        >>> table[["library", "method", "noise", "seed", "status"]].to_string(index=False, header=False)
        'lib2 stlsq 0.01 1 ok'
    """
    from latticebench.bench.choice import chosen
    from latticebench.bench.run import run as run_suite
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    patterns = [only] if isinstance(only, str) else only
    contestants = [methods] if isinstance(methods, (str, Path)) else methods
    choice = chosen(patterns, map(str, contestants), seeds)
    loaded = load(str(suite), choice=choice)
    place = Path(folder) if folder is not None else Path("runs") / loaded.name
    about = {"command": FROM_PYTHON, **loaded.about, "jobs": jobs, "chosen": str(choice)}
    _, tally = run_suite(loaded, create(place), jobs=jobs, about=about)
    return Run(place, dict(tally.statuses))


def _numbers(column: pd.Series[Any]) -> pd.Series[Any]:
    """Return a column of texts as numbers, where all that it holds are numbers."""
    known = column[column != ""]
    values = pd.to_numeric(known, errors="coerce")
    return pd.to_numeric(column, errors="coerce") if len(known) and values.notna().all() else column
