"""A fit of recorded samples in a process of its own: what a method of the user's does there ends with it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from latticebench import methods
from latticebench.bench.case import Case, Folders, Roots, plain
from latticebench.bench.pool import Pool
from latticebench.methods.method import Fit, Skipped, make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, library
from latticebench.systems.layout import Layout
from latticebench.systems.readers import read_all
from latticebench.systems.stencil import Ends

# What of a fit comes back, besides its coefficients.
NUMBERS = ("residual", "seconds", "cpu_seconds")


class Apart(Case):
    """The fit of a library to the samples of files.

    Attributes:
        files, ends, layout: the samples.
        terms, order: the equation.
        method, settings: who fits it, the settings as texts of a command line.
        seed: of the method's draws.
    """

    kind: Literal["apart"] = "apart"
    files: tuple[Path, ...]
    ends: Ends
    terms: tuple[str, ...]
    order: int
    method: str
    settings: dict[str, str]
    seed: int
    layout: Layout = Layout()

    @property
    def title(self) -> str:
        """The method and the first file."""
        return f"{self.method} | {self.files[0]}"

    @property
    def roots(self) -> Roots:
        """The method."""
        return Roots(__name__, method=self.method)

    def blank(self) -> dict[str, Any]:
        """Return the names of what comes back."""
        return dict.fromkeys(["name", "coefficients", "stderr", "note", *NUMBERS])

    def run(self, folders: Folders, found: dict[str, Any]) -> None:
        """Read the samples and fit them; see `Case.run`."""
        method = make(methods.find(self.method, folders.suite), self.settings, texts=True)
        fit = solve(
            method, read_all(self.files, self.ends, self.layout), library("terms", self.terms), self.order, self.seed
        )
        found.update(name=fit.method, note=fit.status, coefficients=fit.coefficients.tolist())
        found["stderr"] = None if fit.stderr is None else [plain(one) for one in fit.stderr]
        found.update({name: plain(getattr(fit, name)) for name in NUMBERS})


def fit_apart(case: Apart, candidates: Library) -> Fit:
    """Fit in a process of its own, within the limits of the case; the end of what it prints goes to standard error.

    Args:
        case: the fit.
        candidates: the library of its terms.

    Returns:
        the fit, without its history.

    Raises:
        Skipped: the method cannot take the samples.
        InputError: it failed, passed a limit, or its process ended; the text says what it printed.
    """
    results: list[dict[str, Any]] = []
    with Pool(1) as pool:
        pool.run([case], Folders(), begin=lambda _: "run", keep=lambda _, result: results.append(result))
    (found,) = results
    if found["status"] == "skipped":
        raise Skipped(found["reason"])
    if found["status"] != "ok":
        raise InputError(f"method {case.method!r}: {found['status']}: {found['reason']}")
    stderr = None if found["stderr"] is None else _read(found["stderr"])
    numbers = dict(zip(NUMBERS, _read([found[name] for name in NUMBERS]).tolist(), strict=True))
    if found["reason"]:
        print(f"method {case.method!r}: {found['reason']}", file=sys.stderr)
    return Fit(
        str(found["name"]), candidates, case.order, _read(found["coefficients"]), stderr=stderr, status=found["note"],
        **numbers,
    )  # fmt: skip


def _read(values: Sequence[float | str | None]) -> np.ndarray:
    """Return numbers as `plain` writes them."""
    return np.array([np.nan if value is None else float(value) for value in values])
