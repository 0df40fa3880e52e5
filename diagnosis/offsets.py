"""Offsets of sensors that were found as constant forces: a linear chain cannot tell the two apart."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.contest import BETTER, EQUAL
from latticebench.diagnosis.model import Fitted, without
from latticebench.diagnosis.polish import polish

if TYPE_CHECKING:
    from numpy import ndarray

# What sensors' offsets are called that can only be forces.
FORCES = "a constant force of its own at each site"


def settled(fitted: Fitted) -> Fitted:
    """Return a fit with offsets that were found as forces written as offsets, where that fits as well."""
    for number, placed in enumerate(fitted.model.effects):
        other = _as_offset(fitted, number) if placed.as_force else None
        if other is not None and other.gain(fitted) > -EQUAL:
            fitted = other
    return fitted


def _as_offset(fitted: Fitted, number: int) -> Fitted | None:
    """Return the fit of an effect that is written as forces as offsets; None where there is none."""
    placed, rest = fitted.model.effects[number], _rest(fitted)
    if rest is None:
        return None
    smaller = without(fitted, number)
    psi = dict(zip(placed.psi, (float(x) for x in rest), strict=True))
    effects = list(fitted.model.effects)
    effects[number] = replace(placed, as_force=False, psi=psi)
    return polish(replace(fitted.model, effects=tuple(effects)), smaller)


def lead_of_forces(fitted: Fitted) -> tuple[str, float] | None:
    """Return what forces are called that sensors' offsets cannot be, and their lead; None where offsets fit as well."""
    for number, placed in enumerate(fitted.model.effects):
        other = _as_offset(fitted, number) if placed.as_force else None
        if other is not None and fitted.gain(other) > 2 * BETTER:
            return FORCES, fitted.gain(other) / 2
    return None


def _rest(fitted: Fitted) -> ndarray | None:
    """Return the reading of each site at which the equation with the constant forces rests; None where it has none."""
    from scipy.optimize import root

    record = fitted.records[0]
    dynamics = record.stretches.dynamics
    sites, size = dynamics.sites, dynamics.size
    if dynamics.count != sites:
        return None
    start = np.mean(np.concatenate(fitted.solution.state.nodes), axis=0)[:sites]
    t = record.times[:1]

    def push(u: ndarray) -> ndarray:
        y = np.concatenate([u, np.zeros(sites)])[None]
        f = np.zeros((1, sites)) if record.stretches.inputs is not None else None
        rate = dynamics.linear(fitted.solution.state.coefficients, t, y, f, None, derivatives=False)[0]
        return np.asarray(rate[0, size - sites :])

    found = root(push, start)
    return np.asarray(found.x) if found.success else None
