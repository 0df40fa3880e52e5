"""Recordings in xarray's objects, as the tables that `latticebench.systems.readers` reads; xarray need not be there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.systems.errors import InputError
from latticebench.systems.layout import Layout, quoted

if TYPE_CHECKING:
    from numpy import ndarray

TIMES = ("time", "t")
# Longer units are remarks.
LONGEST = 12


def is_labelled(source: Any) -> bool:
    """Return whether something is a DataArray or a Dataset of xarray."""
    return type(source).__module__.partition(".")[0] == "xarray" and hasattr(source, "dims")


def as_table(source: Any, layout: Layout) -> tuple[pd.DataFrame, Layout]:
    """Return a labelled recording as a table, and the layout that reads it.

    A variable with a dimension besides the time becomes one column per site: `theta` becomes theta1, theta2, ...; its
    units and those of the times come from their attribute `units`, and stand in the names of the columns.

    Args:
        source: a DataArray or a Dataset.
        layout: `time` is a dimension; `columns` are names of variables, or of columns as above, or patterns.

    Raises:
        InputError: there is no dimension of time, it has no times, or a variable has more than two dimensions.
    """
    data = source
    if not hasattr(source, "data_vars"):
        name = "u" if source.name is None else str(source.name)
        data = source.to_dataset(name=name)
        layout = layout if layout.columns else replace(layout, columns=(name,))
    time = _time(data, layout)
    known = {str(name): one for name, one in data.data_vars.items() if time in one.dims}
    asked = layout.columns or (("u",) if "u" in known else tuple(known) if len(known) == 1 else ())
    times, label = _times(data[time])
    table, names = {label: times}, {}
    for name, one in known.items():
        own = dict(_columns(name, one, time, asked=name in asked))
        names[name] = list(own)
        table |= own
    # The columns of a complex field have names that need not be asked for.
    plain = any(np.iscomplexobj(known[name]) for name in asked if name in known)
    columns = () if plain else tuple(column for name in asked for column in names.get(name, [name]))
    return pd.DataFrame(table), replace(layout, time=label, columns=columns)


def _time(data: Any, layout: Layout) -> str:
    """Return the dimension of the time.

    Raises:
        InputError: there is none, or it has no times.
    """
    dims = [str(one) for one in data.dims]
    time = layout.time or next((one for one in TIMES if one in dims), "")
    if time not in dims:
        wanted = quoted(time) if time else "time or t"
        raise InputError(f"there is no dimension {wanted}, but {', '.join(map(quoted, dims))}; name it with time=")
    if time not in data.coords:
        raise InputError(f"dimension {time} has no times; give them with .assign_coords({time}=...)")
    return time


def _times(given: Any) -> tuple[ndarray, str]:
    """Return times, durations as seconds, and the name of their column."""
    values, unit = given.to_numpy(), str(given.attrs.get("units", "")).split(" since ")[0]
    if values.dtype.kind == "m":
        values, unit = values / np.timedelta64(1, "s"), "s"
    return values, _named(str(given.name), unit)


def _columns(name: str, one: Any, time: str, *, asked: bool) -> Iterator[tuple[str, ndarray]]:
    """Yield the columns of a variable; those that are asked for have their units in their names.

    Raises:
        InputError: it has more than two dimensions.
    """
    others = [dim for dim in one.dims if dim != time]
    if len(others) > 1:
        raise InputError(
            f"{quoted(name)} has dimensions {', '.join(map(str, one.dims))}; a recording has {time} and one of sites: "
            "choose with .isel or .sel"
        )
    values = one.transpose(time, ...).to_numpy()
    unit = str(one.attrs.get("units", "")) if asked else ""
    fields = {"re": values.real, "im": values.imag} if asked and np.iscomplexobj(values) else {name: values}
    for letter, field in fields.items():
        if field.ndim == 1 and letter == name:
            yield _named(name, unit), field
            continue
        for site, column in enumerate(field.reshape(len(field), -1).T, 1):
            yield (_named(f"{letter}{site}", unit) if letter == name else f"{letter}{site}"), column


def _named(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if 0 < len(unit) <= LONGEST and not set(unit) & set("[]()") else name
