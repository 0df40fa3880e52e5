"""Find the equations of motion of nonlinear lattices from data, and measure how well each method does it.

Four rooms, each loaded when it is first used and importing only from those above it in this list:

- `latticebench.systems`: what is studied - terms, lattices, samples, simulation;
- `latticebench.methods`: how an equation is found - the protocol, and one file per method;
- `latticebench.diagnosis`: what a declared equation lacks;
- `latticebench.bench`: how methods are compared - suites, runner, scores, tables, figures, command line.
"""

from __future__ import annotations

import importlib
from types import ModuleType

ROOMS = ("systems", "methods", "diagnosis", "bench")

__all__ = ["__version__", *ROOMS]


def __getattr__(name: str) -> ModuleType | str:
    """Import a room, or look the installed version up, when it is first asked for.

    Raises:
        AttributeError: there is no such name.
    """
    if name in ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    if name == "__version__":
        from importlib.metadata import version

        return version("latticebench")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Name what can be asked for."""
    return sorted(__all__)
