"""Types of settings with their bounds, and the one check of a setting: `threshold: NotNegative = 0.05`."""

from __future__ import annotations

import functools
import json
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from annotated_types import Ge, Gt, Le, MinLen

from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    import pydantic

# More of anything is a slip.
MOST = Le(10**9)
Count = Annotated[int, Ge(1), MOST]
CountOrNone = Annotated[int, Ge(0), MOST]
Several = Annotated[int, Ge(2), MOST]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
SOME = MinLen(1)

# Where pydantic's words would not say it best.
WORDS = {
    "greater_than": "it must be above {gt:g}", "greater_than_equal": "it must be at least {ge:g}",
    "less_than": "it must be below {lt:g}", "less_than_equal": "it must be at most {le:g}",
    "literal_error": "it must be one of {expected}", "too_short": "there must be at least {min_length}",
}  # fmt: skip
FINITE = "it must be a finite number"


def checked(kind: type, name: str, value: Any, *, text: bool = False) -> Any:
    """Return a setting in the type of its field.

    Args:
        kind: the class that has the field.
        name: of the field.
        value: a value, which must have the type (a list stands for a tuple, a whole number for a real one, and neither
            true nor "1" for 1), or the text of one.
        text: it is the text of one, from a command line.

    Raises:
        InputError: it is of another type, out of range, or not finite.
    """
    import pydantic

    adapter = _adapter(kind, name)
    try:
        if text and not value.startswith(("[", "{")):
            return adapter.validate_python(value)
        try:
            as_json = json.dumps(json.loads(value) if text else value, allow_nan=False)
        except TypeError:
            return adapter.validate_python(value, strict=True)
        return adapter.validate_json(as_json, strict=True)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        reason = WORDS.get(first["type"], first["msg"].lower()).format(**first.get("ctx", {}))
        place = "".join(f"[{part}]" for part in first["loc"])
    except RecursionError:
        reason, place = "it is nested too deeply", ""
    except ValueError as error:
        reason, place = str(error) if isinstance(error, json.JSONDecodeError) else FINITE, ""
    raise InputError(f"setting {name}{place} = {_short(value)}: {reason}")


def _short(value: Any) -> str:
    try:
        shown = repr(value)
    except ValueError:
        # A whole number of thousands of digits.
        return "a number of too many digits"
    return shown if len(shown) <= 80 else f"{shown[:77]}..."


@functools.lru_cache(maxsize=1024)
def _adapter(kind: type, name: str) -> pydantic.TypeAdapter[Any]:
    import pydantic

    hint = get_type_hints(kind, include_extras=True)[name]
    return pydantic.TypeAdapter(hint, config=pydantic.ConfigDict(allow_inf_nan=False))
