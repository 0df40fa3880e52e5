"""How an option is said in a message: as on the command line, or as an argument of a function of Python."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_IN_PYTHON = ContextVar("in_python", default=False)


def called_from_python(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose messages say options as arguments.

    >>> called_from_python(option)("time-scale", "ms")
    "time_scale='ms'"
    """

    @functools.wraps(function)
    def spoken(*arguments: P.args, **words: P.kwargs) -> R:
        before = _IN_PYTHON.set(True)
        try:
            return function(*arguments, **words)
        finally:
            _IN_PYTHON.reset(before)

    return spoken


def option(name: str, value: str | float | bool | tuple[float, ...] | None = None) -> str:
    """Return an option as it is given, with its value if one is known; True is that of a switch.

    >>> option("time-scale", "ms"), option("sort", True), option("columns", "theta_*")
    ('--time-scale ms', '--sort', '--columns "theta_*"')
    >>> option("between", (2.5, 40.0))
    '--between 2.5 40'
    """
    if _IN_PYTHON.get():
        argument = name.replace("-", "_")
        return argument if value is None else f"{argument}={_plain(value)}"
    if value is None or value is True:
        return f"--{name}"
    if isinstance(value, tuple):
        return f"--{name} {' '.join(map(_plain, value))}"
    text = value if isinstance(value, str) else f"{value:.16g}"
    return f"--{name} {text}" if re.fullmatch(r"[\w.,+-]+", text) else f'--{name} "{text}"'


def options(**given: str | float | bool) -> str:
    """Return several options beside each other.

    >>> options(time="time_s", columns="theta_*_deg")
    '--time time_s --columns "theta_*_deg"'
    """
    return beside(*(option(name.replace("_", "-"), value) for name, value in given.items()))


def beside(*told: str) -> str:
    """Return options and settings that are given together.

    >>> beside(option("method", "stlsq"), setting("differentiation", "spline"))
    '--method stlsq --set differentiation=spline'
    """
    return (", " if _IN_PYTHON.get() else " ").join(told)


def setting(name: str, value: str) -> str:
    """Return a setting of a method as it is given.

    >>> setting("differentiation", "spline")
    '--set differentiation=spline'
    """
    return f"{name}={value!r}" if _IN_PYTHON.get() else f"--set {name}={value}"


def _plain(value: str | float | bool | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_plain, value))})"
    return f"{value:.16g}" if isinstance(value, float) else repr(value)
