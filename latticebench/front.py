"""What is done with a recording and a model in a notebook; see `latticebench` for the list of names.

    import latticebench as lb

    data = lb.read("pendula.csv", time="time_s", columns="theta_*_deg", scale="deg")
    model = lb.Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
    fit = lb.fit(data, model)
    cause = lb.diagnose(data, model)

Results show themselves in a notebook as tables or pages; tables are pandas DataFrames.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench import methods
from latticebench.bench.adequacy import Adequacy, adequacy
from latticebench.bench.inspection import sine_warning
from latticebench.bench.report.mathematics import written
from latticebench.methods.method import Fit, Skipped, make, solve
from latticebench.recording import Model, Recording
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.motion import Motion
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import integrate
from latticebench.systems.terms import combination

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from latticebench.bench.limit import Design, Limit
    from latticebench.bench.report.content import Report
    from latticebench.diagnosis.repair import Diagnosis


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit of a model to a recording.

    Attributes:
        result: coefficients, standard errors, seconds, ... (`latticebench.methods.method.Fit`).
        quality: how well the equation describes the readings.
        model, data: what was fitted to what.
    """

    result: Fit
    quality: Adequacy
    model: Model
    data: Recording

    @property
    def table(self) -> pd.DataFrame:
        """The coefficients by term, with standard errors where the method gives them."""
        columns: dict[str, Any] = {"coefficient": self.result.coefficients}
        if self.result.stderr is not None:
            columns["standard error"] = self.result.stderr
        return pd.DataFrame(columns, index=pd.Index(self.result.library.texts, name="term"))

    @property
    def equation(self) -> str:
        """The equation with its coefficients, in one line."""
        return written(self.result)

    @property
    def latex(self) -> str:
        """The equation in LaTeX."""
        from latticebench.bench.report.mathematics import expression, latex_summand

        pairs = [pair for pair in zip(self.result.library.texts, self.result.coefficients, strict=True) if pair[1]]
        sums = [latex_summand(float(value), expression(text), first=not k) for k, (text, value) in enumerate(pairs)]
        return rf"\{'d' * self.model.order}ot{{u}}_{{n}} = {' '.join(sums) or '0'}"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What has to be known before a number is used; empty where the equation fits."""
        return self.quality.warnings

    def confidence(self, level: float = 0.95) -> pd.DataFrame:
        """Return the interval of each coefficient that holds the truth with a probability, if the equation is right.

        Raises:
            InputError: the method gives no standard errors, or the level is not between 0 and 1.
        """
        from scipy.stats import norm

        if self.result.stderr is None:
            raise InputError(f"method {self.result.method!r} gives no standard errors; fit with another")
        if not 0 < level < 1:
            raise InputError(f"level is {level!r}; it must be between 0 and 1")
        half = float(norm.isf((1 - level) / 2)) * self.result.stderr
        bounds = {"lower": self.result.coefficients - half, "upper": self.result.coefficients + half}
        return pd.DataFrame(bounds, index=self.table.index)

    def simulate(self, u: ArrayLike, v: ArrayLike | None = None, *, t: ArrayLike) -> Recording:
        """Return the motion of the fitted equation from a state.

        Args:
            u: the field at the first time (sites,).
            v: its velocity, for order 2; at rest if not given.
            t: times (T,).

        Raises:
            InputError: the ends are unknown, or the motion grows without bound.
        """
        if self.model.ends == "unknown":
            raise InputError('a chain with unknown ends cannot be simulated; give the model ends, such as ends="free"')
        start, times = np.asarray(u), np.asarray(t, float)
        term = combination(self.result.library.terms, [float(value) for value in self.result.coefficients])
        chain = Motion(term, self.model.order, np.iscomplexobj(start), len(start), self.model.ends)
        states = integrate(chain, chain.pack(start, None if v is None else np.asarray(v)), times)
        found = chain.unpack(states)
        return Recording((Samples(times, found[0], found[1], source="fitted equation", ends=self.model.ends),))

    def __repr__(self) -> str:
        lines = [f"Warning: {line}." for line in self.warnings]
        return "\n".join([*lines, self.equation, self.table.to_string(), self.quality.in_words])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p><b>Warning:</b> {html.escape(line)}.</p>" for line in self.warnings)
        told = f"<p><code>{html.escape(self.equation)}</code></p>"
        return f"{lines}{told}{_table(self.table, index=True)}<p>{html.escape(self.quality.in_words)}</p>"


def fit(data: Recording, model: Model, method: str = "trajectory", seed: int = 1, **settings: Any) -> Fitted:
    """Fit the coefficients of a model to a recording.

    Args:
        data: the recording.
        model: the equation.
        method: a name from `latticebench list methods`, or a .py file.
        seed: of the method's own draws.
        settings: of the method.

    Raises:
        InputError: the method cannot fit such a recording.

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 10, 200)
        >>> data = lb.read((t, np.cos(1.5 * t)))
        >>> found = lb.fit(data, lb.Model("u[n]", ends="free"), method="least-squares")
        >>> round(float(found.table.loc["u[n]", "coefficient"]), 3)
        -2.25
        >>> found.warnings
        ()
    """
    samples, terms = model.of(data), model.library
    try:
        result = solve(make(methods.find(method), settings), samples, terms, model.order, seed)
    except Skipped as reason:
        raise InputError(f"method {method!r} cannot fit {samples[0].source}: {reason}; choose another") from None
    return Fitted(result, adequacy(samples, result).also(sine_warning(samples, terms)), model, data)


@dataclass(frozen=True, eq=False)
class Cause:
    """A diagnosis: what an equation lacks of a recording.

    Attributes:
        result: all that is known (`latticebench.diagnosis.repair.Diagnosis`).
        report: what is said of it.
        declared: the equation that was examined.
    """

    result: Diagnosis
    report: Report
    declared: Model

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

    @property
    def model(self) -> Model:
        """The declared terms and those found that act at every site; what acts elsewhere is in `elsewhere`."""
        terms = "; ".join(one.text for one in self.report.equation.after.terms)
        return Model(terms, self.declared.order, self.declared.ends)

    @property
    def elsewhere(self) -> tuple[str, ...]:
        """What acts at single sites, at the ends and on the readings, one sentence each."""
        return self.report.equation.after.elsewhere

    @property
    def page(self) -> str:
        """The page, as HTML."""
        from latticebench.bench.report.curves import curves
        from latticebench.bench.report.page import page

        return page(self.report, curves(self.result))

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all."""
        from latticebench.systems.files import write_text

        write_text(Path(path), self.page)
        return Path(path)

    def __repr__(self) -> str:
        lines = [self.report.sentence, self.report.equation.after.text]
        return "\n".join([*lines, *(f"    {line}" for line in self.elsewhere)])

    def _repr_html_(self) -> str:
        # In a frame, so that the page's styles stay its own.
        return f'<iframe srcdoc="{html.escape(self.page)}" style="width:100%;height:40em;border:0"></iframe>'


def diagnose(data: Recording, model: Model) -> Cause:
    """Find what a declared equation lacks of a recording.

    Raises:
        InputError: the equation cannot be set up on it.
    """
    from latticebench.bench.report.content import content
    from latticebench.diagnosis import repair

    found = repair.diagnose(model.library, model.order, model.of(data), CATALOGUE)
    return Cause(found, content(found), model)


@dataclass(frozen=True, eq=False)
class Bound:
    """How well any method could know the coefficients from a recording.

    Attributes:
        result: the bound (`latticebench.bench.limit.Limit`).
        needed: what a smaller error needs.
        notes: where it is taken, and the noise of each sensor.
        warnings: why it may not hold.
    """

    result: Limit
    needed: Design
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = field(default=())

    @property
    def table(self) -> pd.DataFrame:
        """Each term's coefficient, smallest standard error and verdict."""
        one = self.result
        columns = {"coefficient": one.coefficients, "smallest error": one.stderr, "verdict": one.verdicts}
        return pd.DataFrame(columns, index=pd.Index(one.library.texts, name="term"))

    def __repr__(self) -> str:
        return "\n".join([*(f"Warning: {line}." for line in self.warnings), self.table.to_string(), *self.notes])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p><b>Warning:</b> {html.escape(line)}.</p>" for line in self.warnings)
        return f"{lines}{_table(self.table, index=True)}<p>{'<br>'.join(map(html.escape, self.notes))}</p>"


def limit(data: Recording, model: Model, target: float = 0.01) -> Bound:
    """Return how well any method could know a model's coefficients from a recording.

    Args:
        data: the recording.
        model: the equation.
        target: a relative error of the coefficients; `needed` says what it takes.

    Raises:
        InputError: the equation cannot be set up on the recording.
    """
    from latticebench.bench.bounds import of_recordings
    from latticebench.bench.limit import design

    samples = model.of(data)
    try:
        found = of_recordings(samples, model.library, model.order)
    except Skipped as reason:
        raise InputError(f"{samples[0].source}: {reason}") from None
    return Bound(found.at(1, 1), design(found.at, target=target), tuple(found.note.splitlines()), tuple(found.warnings))


def results(name: str | Path) -> Mapping[str, pd.DataFrame]:
    """Return the tables of a published run, or of a folder with published tables, by name.

    Args:
        name: a folder; or the name of one in `results` of a copy of this project's repository.

    Raises:
        InputError: there are no tables.
    """
    from latticebench.bench.published import folder_of, read_table

    folder = Path(name) if Path(name).is_dir() else folder_of(str(name))
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise InputError(
            f"{name}: there are no published tables; give a folder with .csv files of `latticebench table`"
        )
    found = {path.stem: read_table(path) for path in paths}
    return {key: frame.apply(_numbers) for key, frame in found.items()}


@dataclass(frozen=True, eq=False)
class Run:
    """The results of a suite.

    Attributes:
        folder: where they are kept.
        statuses: how many cases ended how.
    """

    folder: Path
    statuses: Mapping[str, int]

    def table(self) -> pd.DataFrame:
        """Return one row per case."""
        from latticebench.bench.compare import read_run

        return read_run(self.folder)

    def __repr__(self) -> str:
        return (
            f"Run({', '.join(f'{count} {status}' for status, count in self.statuses.items())}; kept in {self.folder})"
        )

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self))}</p>{_table(self.table())}"


def run(
    suite: str | Path,
    *,
    only: Sequence[str] = (),
    methods: Sequence[str | Path] = (),
    seeds: str | Sequence[int] | None = None,
    jobs: int = 1,
    folder: str | Path | None = None,
) -> Run:
    """Run a suite or a part of it, continuing where it was stopped.

    Args:
        suite: a name from `latticebench list suites`, or a .toml file.
        only: patterns such as "phi4*"; cases whose title, part, system, library, method or effect is so.
        methods: in place of the suite's: its labels, names from `latticebench list methods`, or .py files.
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
        >>> table[["case", "status"]].to_string(index=False, header=False)
        'phi4 noise=0.01 | lib2 | stlsq | seed 1 ok'
    """
    from latticebench.bench.choice import chosen
    from latticebench.bench.run import run as run_suite
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    choice = chosen(only, map(str, methods), seeds)
    loaded = load(str(suite), choice=choice)
    place = Path(folder) if folder is not None else Path("runs") / loaded.name
    about = {"suite": loaded.name, "jobs": jobs, "chosen": str(choice)}
    _, tally = run_suite(loaded, create(place), jobs=jobs, about=about)
    return Run(place, dict(tally.statuses))


def _numbers(column: pd.Series[Any]) -> pd.Series[Any]:
    """Return a column of texts as numbers, where all that it holds are numbers."""
    known = column[column != ""]
    values = pd.to_numeric(known, errors="coerce")
    return pd.to_numeric(column, errors="coerce") if len(known) and values.notna().all() else column


def _table(frame: pd.DataFrame, *, index: bool = False) -> str:
    return str(frame.to_html(index=index, float_format=lambda value: f"{value:.5g}", border=0))
