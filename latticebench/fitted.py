"""A model fitted to a recording: its coefficients, what it leaves, and how it moves."""

from __future__ import annotations

import functools
import html
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench import methods
from latticebench.bench import calls
from latticebench.bench.adequacy import Adequacy
from latticebench.bench.overlay import Overlay, of_fit
from latticebench.bench.report.mathematics import written
from latticebench.bench.report.rows import html_table
from latticebench.bench.report.units import of_coefficients, units_of
from latticebench.exhibit import Exhibit
from latticebench.methods.method import Fit, make
from latticebench.pictures import Picture
from latticebench.recording import Model, Recording
from latticebench.systems.errors import InputError
from latticebench.systems.motion import Motion
from latticebench.systems.options import called_from_python
from latticebench.systems.samples import Origin, Samples
from latticebench.systems.simulate import integrate
from latticebench.systems.terms import combination

if TYPE_CHECKING:
    from numpy import ndarray
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Residual:
    """What a fitted equation leaves of a recording: readings less the motion of the equation that is nearest to them.

    Of several trajectories it is that of which most is left, of a very long one its first rows.

    Attributes:
        overlay: readings and motion, in the unit of the file (`latticebench.bench.overlay.Overlay`).

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 10, 100)
        >>> noise = 0.01 * np.random.default_rng(1).standard_normal(100)
        >>> data = lb.read((t, np.cos(1.5 * t) + noise))
        >>> left = lb.fit(data, lb.Model("u[n]", ends="free")).residual
        >>> left
        Residual(arrays: 0.0085 as root mean square, ... times the noise)
        >>> left.to_frame().shape
        (100, 2)
        >>> left.plot()
        Picture(arrays: residual, spectrum)
    """

    overlay: Overlay

    @property
    def values(self) -> ndarray:
        """The residual (T, N), real or complex, in the unit of the readings; NaN where nothing is known."""
        (curve,) = self.overlay.curves.values()
        parts = self.overlay.seen - curve
        return np.asarray(parts[:, 0] + 1j * parts[:, 1] if self.overlay.is_complex else parts[:, 0])

    @property
    def rms(self) -> float:
        """Its root mean square, in the unit of the readings."""
        return float(np.sqrt(np.nanmean(np.abs(self.values) ** 2)))

    @property
    def times(self) -> float:
        """Its root mean square in units of the noise; NaN where the readings do not show their noise."""
        if self.overlay.noise is None:
            return float("nan")
        (name,) = self.overlay.curves
        return float(np.sqrt(np.nanmean(self.overlay.residual(name) ** 2)))

    def to_frame(self) -> pd.DataFrame:
        """Return times and residuals, in the unit of the file (`Recording.to_frame` has that of the equation)."""
        columns = {f"u{site}": values for site, values in enumerate(self.values.T, 1)}
        return pd.DataFrame({"t": self.overlay.t, **columns})

    def plot(self, *only: str) -> Picture:
        """Draw it in space and time, and its spectrum; or the panels that are named."""
        return Picture(self.overlay, only or ("residual", "spectrum"))

    def __repr__(self) -> str:
        unit = f" {self.overlay.unit}" if self.overlay.unit else ""
        noise = "" if np.isnan(self.times) else f", {self.times:.2g} times the noise"
        return f"Residual({self.overlay.source}: {self.rms:.2g}{unit} as root mean square{noise})"

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self))}</p>{html_table(self.to_frame().drop(columns='t').describe(), index=True)}"


@dataclass(frozen=True, eq=False)
class Fitted(Exhibit):
    """A fit of a model to a recording.

    Attributes:
        result: coefficients, standard errors, seconds, ... (`latticebench.methods.method.Fit`).
        quality: how well the equation describes the readings.
        model, data: what was fitted to what.

    Examples:
        >>> import latticebench as lb
        >>> import numpy as np
        >>> t = np.linspace(0, 20, 200)
        >>> noise = 0.01 * np.random.default_rng(1).standard_normal(200)
        >>> data = lb.read((t, np.cos(1.5 * t) + noise))
        >>> found = lb.fit(data, lb.Model("u[n]; 1", ends="free"))
        >>> lower, upper = found.confidence().loc["u[n]"]
        >>> bool(-2.3 < lower < -2.25 < upper < -2.2)
        True
        >>> found.covariance.shape
        (2, 2)
        >>> found.simulate(t=[0, 1, 2]).to_frame().round(1)
             t   u1   v1
        0  0.0  1.0 ...
        1  1.0  0.1 ...
        2  2.0 -1.0 ...
    """

    result: Fit
    quality: Adequacy
    model: Model
    data: Recording

    @property
    def table(self) -> pd.DataFrame:
        """The coefficients by term, with standard errors and units where they are known."""
        columns: dict[str, Any] = {"coefficient": self.result.coefficients}
        if self.result.stderr is not None:
            columns["standard error"] = self.result.stderr
        if own := of_coefficients(self.result.library.terms, self.result.order, units_of(self.data.samples[0].origin)):
            columns["unit"] = own
        return pd.DataFrame(columns, index=self._terms)

    @property
    def _terms(self) -> pd.Index[str]:
        return pd.Index(self.result.library.texts, name="term")

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

    @functools.cached_property
    def covariance(self) -> pd.DataFrame:
        """The covariance of the coefficients, of a method that follows a motion and gives standard errors.

        Raises:
            InputError: the method does not; `trajectory` does.
        """
        from latticebench.bench.bounds import covariance_of_fit

        found = covariance_of_fit(self.model.of(self.data), self.result)
        return pd.DataFrame(found, index=self._terms, columns=self._terms)

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
        return pd.DataFrame(bounds, index=self._terms)

    @functools.cached_property
    def residual(self) -> Residual:
        """What the equation leaves of the readings."""
        return Residual(self.overlay)

    @functools.cached_property
    def overlay(self) -> Overlay:
        """Readings and motion, in the unit of the file (`latticebench.bench.overlay.Overlay`)."""
        return of_fit(self.model.of(self.data), self.result)

    def simulate(
        self, u: ArrayLike | None = None, v: ArrayLike | None = None, *, t: ArrayLike | None = None
    ) -> Recording:
        """Return the motion of the fitted equation from a state.

        Args:
            u: the field at the first time (sites,); where the first trajectory of the recording begins if not given.
            v: its velocity, for order 2; likewise, or at rest where u is given alone.
            t: times (T,); those of the recording if not given.

        Raises:
            InputError: the ends are unknown, the field is not that of the chain, the equation has a measured input, or
                the motion grows without bound.
        """
        if self.model.ends == "unknown":
            raise InputError('a chain with unknown ends cannot be simulated; give the model ends, such as ends="free"')
        if u is None:
            u, begun = self._start()
            v = begun if v is None else v
        sites = self.data.samples[0].sites
        for name, field in (("u", u), ("v", v)):
            if field is not None and np.shape(field) != (sites,):
                raise InputError(
                    f"{name} has shape {np.shape(field)}: the chain has {sites} site{'s' * (sites > 1)}, one number "
                    "each; times are given as t=..."
                )
        start, times = np.asarray(u), np.asarray(self.data.samples[0].t if t is None else t, float)
        term = combination(self.result.library.terms, [float(value) for value in self.result.coefficients])
        chain = Motion(term, self.model.order, np.iscomplexobj(start), len(start), self.model.ends)
        states = integrate(chain, chain.pack(start, None if v is None else np.asarray(v)), times)
        found = chain.unpack(states)
        return Recording((Samples(times, found[0], found[1], source="fitted equation", ends=self.model.ends),))

    def _start(self) -> tuple[ndarray, ndarray | None]:
        """Return where the motion of the equation begins that is nearest to the first trajectory.

        Raises:
            InputError: the equation cannot be followed.
        """
        from scipy.interpolate import make_interp_spline

        if self.result.motion is not None:
            moved = self.result.motion[0]
            return moved.u[0], None if moved.v is None else moved.v[0]
        first = replace(self.model.of(self.data)[0], origin=Origin())
        near = Residual(of_fit([first], self.result))
        moves = first.u[: len(near.values)] - near.values
        if not np.all(np.isfinite(moves)):
            raise InputError(f"{first.source}: no start is known; give u, and v for order 2")
        slope = make_interp_spline(near.overlay.t, moves, k=min(5, (len(moves) - 1) // 2 * 2 + 1)).derivative()
        return moves[0], slope(near.overlay.t[0]) if self.model.order == 2 else None

    def __repr__(self) -> str:
        lines = [f"Warning: {line}." for line in self.warnings]
        return "\n".join([*lines, self.equation, self.table.to_string(), self.quality.in_words])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p><b>Warning:</b> {html.escape(line)}.</p>" for line in self.warnings)
        told = f"<p><code>{html.escape(self.equation)}</code></p>"
        return f"{lines}{told}{html_table(self.table, index=True)}<p>{html.escape(self.quality.in_words)}</p>"


@called_from_python
def fit(data: Recording, model: Model, method: str = methods.DEFAULT, seed: int = 1, **settings: Any) -> Fitted:
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
    samples = Model.checked(model).of(data)
    result = calls.fit(samples, model.library, model.order, make(methods.find(method), settings), seed)
    return Fitted(result, calls.judged(samples, result), model, data)
