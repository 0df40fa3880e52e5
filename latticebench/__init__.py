"""Find the equations of motion of nonlinear lattices from data, and measure how well each method does it.

For notebooks, each loaded when it is first used:

- `read` or `simulate` a recording, look at it (`plot`, `animate`), `Model` an equation or take that of a `system`;
- `fit` its coefficients, `diagnose` what it lacks, know the `limit` of what can be known;
- `run` a suite of the benchmark, look at published `results`;
- whatever was given wrongly raises `InputError`, whose text says what, where, and what to do.

Four rooms, each importing only from those above it in this list:

- `latticebench.systems`: what is studied - terms, lattices, samples, simulation;
- `latticebench.methods`: how an equation is found - the protocol, and one file per method;
- `latticebench.diagnosis`: what a declared equation lacks;
- `latticebench.bench`: how methods are compared - suites, runner, scores, tables, figures, command line.

Names with a leading underscore, and those of the rooms that are not described in CONTRIBUTING.md, may change.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from latticebench.fitted import Fitted, Residual, fit
    from latticebench.front import Bound, Cause, Run, Tables, diagnose, limit, results, run
    from latticebench.pictures import Film, Picture, Survey
    from latticebench.recording import Inspected, Model, Recording, read, simulate, system
    from latticebench.systems.errors import InputError

# What is done is told to `logging` under the name of the module that does it; nobody hears it who has not asked.
logging.getLogger(__name__).addHandler(logging.NullHandler())

ROOMS = ("systems", "methods", "diagnosis", "bench")
# In which module of this package a name lies.
PLACES = {
    "InputError": "systems.errors",
    "Inspected": "recording", "Model": "recording", "Recording": "recording", "read": "recording",
    "simulate": "recording", "system": "recording",
    "Fitted": "fitted", "Residual": "fitted", "fit": "fitted", "Film": "pictures", "Picture": "pictures",
    "Survey": "pictures",
    "Bound": "front", "Cause": "front", "Run": "front", "Tables": "front", "diagnose": "front", "limit": "front",
    "results": "front", "run": "front",
}  # fmt: skip

__all__ = [
    "Bound", "Cause", "Film", "Fitted", "InputError", "Inspected", "Model", "Picture", "Recording", "Residual", "Run",
    "Survey", "Tables", "__version__", "bench", "diagnose", "diagnosis", "fit", "limit", "methods", "read", "results",
    "run", "simulate", "system", "systems",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a room or what a notebook uses, or look the installed version up, when it is first asked for.

    Raises:
        AttributeError: there is no such name.
    """
    if name == "__version__":
        from importlib.metadata import version

        return version("latticebench")
    if name in ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    if name in PLACES:
        return getattr(importlib.import_module(f"{__name__}.{PLACES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Name what can be asked for."""
    return sorted(__all__)
