"""pysindy's optimisers on a regression.

Rows are divided by the RMS of the derivative and columns by the RMS of their term, so that an optimiser sees each
coefficient as its term's share of the derivative, whatever the units and the number of samples.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.regression import triangular
from latticebench.systems.errors import InputError, unknown

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.regression import Regression


# Thresholds to choose from: shares of the derivative's RMS.
THRESHOLDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Let what draws from NumPy's global generator, as pysindy 2.1 does, draw from a seed; restore it afterwards."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


def make_optimizer(optimizer: str, arguments: Mapping[str, Any]) -> Any:
    """Make one of pysindy's optimisers.

    Args:
        optimizer: class name of the optimiser, such as STLSQ or FROLS.
        arguments: its arguments.

    Raises:
        InputError: there is no such optimiser, or it refuses its arguments.
    """
    import pysindy.optimizers
    from pysindy.optimizers import BaseOptimizer

    known = {
        name for name, kind in vars(pysindy.optimizers).items()
        if isinstance(kind, type) and issubclass(kind, BaseOptimizer) and kind is not BaseOptimizer
    }  # fmt: skip
    if optimizer not in known:
        error = unknown("optimizer", optimizer, known)
        raise InputError(f"{error}; pysindy leaves out those whose solver is not installed (such as cvxpy)")
    try:
        return getattr(pysindy.optimizers, optimizer)(**arguments)
    except Exception as error:
        raise _refused(optimizer, arguments, error) from error


def fitted_optimizer(regression: Regression, optimizer: str, arguments: Mapping[str, Any], seed: int) -> Any:
    """Make one of pysindy's optimisers and fit it to the scaled rows of a regression.

    Args:
        regression: the rows.
        optimizer: class name of the optimiser, such as STLSQ or FROLS.
        arguments: its arguments; thresholds are shares of the derivative's RMS (dimensionless).
        seed: of the draws of an optimiser that bags.

    Returns:
        the fitted optimiser; its `coef_` (1, terms) are shares of the derivative's RMS (dimensionless).

    Raises:
        InputError: there is no such optimiser, or it refuses its arguments or the rows.
    """
    height = regression.height or 1.0
    try:
        # A solver may print its licence, which is no part of the output.
        with warnings.catch_warnings(), seeded(seed), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return make_optimizer(optimizer, arguments).fit(
                regression.design / (regression.scales * height), regression.target[:, None] / height
            )
    except InputError:
        raise
    except Exception as error:
        raise _refused(optimizer, arguments, error) from error


def _refused(optimizer: str, arguments: Mapping[str, Any], error: Exception) -> InputError:
    return InputError(f"pysindy's {optimizer} with {dict(arguments)}: {error}")


def sparse_fit(
    regression: Regression, optimizer: str, arguments: Mapping[str, Any], seed: int
) -> Float[ndarray, " terms"]:
    """Return the coefficients (terms,) that one of pysindy's optimisers finds, in the data's units.

    Args:
        regression: the rows.
        optimizer: class name of the optimiser, such as STLSQ or FROLS.
        arguments: its arguments; thresholds are shares of the derivative's RMS (dimensionless).
        seed: of the draws of an optimiser that bags.

    Raises:
        InputError: there is no such optimiser, or it refuses its arguments or the rows.
    """
    shares = np.asarray(fitted_optimizer(regression, optimizer, arguments, seed).coef_)[0]
    return np.asarray(shares / regression.scales)


def stlsq_path(
    regression: Regression, thresholds: Sequence[float], seed: int
) -> list[tuple[float, Float[ndarray, " terms"]]]:
    """Run STLSQ, without ridge, over a path of thresholds.

    Args:
        regression: the rows.
        thresholds: shares of the derivative's RMS (dimensionless).
        seed: of the draws.

    Returns:
        one pair for each support found: the first threshold that gives it, and least squares on it (terms,).
    """
    small = triangular(regression)
    found, listed = [], set()
    for threshold in thresholds:
        shares = fitted_optimizer(small, "STLSQ", {"threshold": threshold, "alpha": 0.0}, seed).coef_
        support = np.ravel(shares) != 0
        if support.tobytes() not in listed:
            listed.add(support.tobytes())
            found.append((threshold, small.least_squares(support)))
    return found
