"""Writing a fitted equation for people."""

from __future__ import annotations

import ast
from collections.abc import Sequence

from latticebench.methods.method import Fit


def written(fit: Fit, digits: int = 4) -> str:
    """Write the equation found as one line of the term language; absent terms are left out."""
    left = "u'" if fit.order == 1 else "u''"
    return f"{left} = {side(fit.library.texts, [float(value) for value in fit.coefficients], digits)}"


def side(texts: Sequence[str], values: Sequence[float], digits: int = 4) -> str:
    """Write a sum of terms; `0` where every coefficient is 0."""
    parts = []
    for text, value in zip(texts, values, strict=True):
        if value == 0:
            continue
        sign = "-" if value < 0 else "+"
        bare = f"{abs(value):.{digits}g}"
        factor = text if _is_product(text) else f"({text})"
        parts.append(f"{sign} {bare}" if text == "1" else f"{sign} {bare}*{factor}")
    return " ".join(parts).removeprefix("+ ") or "0"


def _is_product(text: str) -> bool:
    """Say whether a term can stand behind a factor without brackets."""
    tree = ast.parse(text.strip(), mode="eval").body
    while isinstance(tree, ast.BinOp) and isinstance(tree.op, (ast.Mult, ast.Div)):
        tree = tree.left
    if isinstance(tree, ast.BinOp):
        return isinstance(tree.op, ast.Pow)
    return not isinstance(tree, (ast.UnaryOp, ast.Constant))
