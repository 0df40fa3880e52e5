"""How a diagnosis of a laboratory recording is judged: what it names, against what is in it.

Each effect must be named, alone or in a group of effects that the diagnosis says it cannot tell apart, by a finding of
its own; what is found beyond that is invented. Several offsets, gains, or curves, of different sensors are one effect.

Intervals are those of the model that is named. Gains are relative: where another sensor gives the unit of u than in the
truth, true values are said in that unit. Where a force is named that does the same as the true one, or is at another
site, the numbers of all forces are those beside that one, and none is compared; likewise of sensors. Offsets count from
the zeros of the outer sensors where the ends are unknown and none of these is named, see `making.LabEffect.beside`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.bench.trials.laboratory.making import LabRecording
    from latticebench.diagnosis.fitting import Fitted
    from latticebench.diagnosis.repair import Diagnosis

# Effects of which one may be found at several sensors.
ONE_FOR_ALL = ("sensor-offset", "sensor-gain", "sensor-curve", "sensor-saturation")
# What an instrument of a kind does by itself: a finding says so, or the noise model holds it.
OF_INSTRUMENT = {"drifting-zero": ("sensor-drift", "sensor-wander")}
# The power of the unit of u by which the parameters of effects grow, where it is not 0.
POWERS = {
    "onsite-quadratic": -1, "onsite-cubic": -2, "onsite-quintic": -4, "quadratic-coupling": -1,
    "nonlinear-coupling": -2, "quadratic-drag": -1, "nonlinear-damping": -2, "dry-friction": 1, "constant-force": 1,
    "drive": 1, "local-drive": 1, "local-friction": 1, "sensor-curve": -2, "sensor-saturation": -3, "sensor-gain": -1,
    "sensor-crosstalk": -1, "sensor-gain-drift": -1, "sensor-gain-jump": -1,
}  # fmt: skip
# The label of what a single sensor has.
SENSOR = (
    r"(offset|gain|curve|lag|jump|growth of the gain|change of the gain|delay|sin|cos) of u(\d+)(?: and v\d+)?"
    r"(?: per time)?"
)
# The label of a wave, and minus the time since which its phase is counted.
WAVE = r"(?:hum of u\d*, )?(cos|sin)\(.*\*(?:t|\(t([+-][^()]*)\))\)"
# The label of a declared term whose coefficient changes steadily.
RAMP = r"(?:t|\(t[^()]*\))/([\d.e+-]+)\*(.*)"
# Labels of values that are no coefficient of a term, with the names that recordings have for them.
NAMED = {
    "omega": "omega",
    "at": "at",
    "width": "width",
    "curve of u": "curve",
    "cubic curve of u": "cubic",
    "scale": "scale",
    "share of both neighbours in each reading": "crosstalk",
    "growth of the gain": "fade",
    "delay": "slow",
    "change of the gain": "change",
    "sin": "sine",
    "cos": "cosine",
    "per_reading": "per_reading",
    "time that the clock loses": "lost",
    "mass beside the site's": "mass",
    "site's mass beside the support's": "mass",
    "gamma": "gamma",
    "drag": "drag",
}
# Half the width of a 95 % interval, in standard errors.
HALF = 1.959964
# A forecast is worse when its error has grown by more than this share of itself.
WORSE = 0.05


@dataclass(frozen=True)
class Finding:
    """An effect that a diagnosis names.

    Attributes:
        name: of the catalogue.
        site: where it acts (0, ..., N-1), or None.
        values: value and standard error of each parameter, called as in `bench.trials.laboratory.effects`.
        alternatives: effects that it cannot be told from.
    """

    name: str
    site: int | None
    values: Mapping[str, tuple[float, float]]
    alternatives: tuple[str, ...] = ()

    @property
    def group(self) -> frozenset[str]:
        """The effect and those that it cannot be told from."""
        return frozenset({self.name, *self.alternatives})


def findings(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    """Return what a diagnosis names, with its values called as parameters of recordings are."""
    return tuple(Finding(one.name, one.site, called(one.values), one.alternatives) for one in diagnosis.findings)


def called(values: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return values by the names that `bench.trials.laboratory.effects` has for them: a gain as the factor.

    Args:
        values: by the labels of the diagnosis, "gain of u2", "cos(3.1*t)", "-v[n]", ...
    """
    found = {}
    for label, (value, error) in values.items():
        sensor, wave, ramp = re.fullmatch(SENSOR, label), re.match(WAVE, label), re.fullmatch(RAMP, label)
        if sensor is not None:
            found[f"{NAMED.get(sensor[1], sensor[1])}_{sensor[2]}"] = (value + (sensor[1] == "gain"), error)
        elif ramp is not None:
            text = ramp[2].removeprefix("(").removesuffix(")") if ramp[2].startswith("(") else ramp[2]
            found[f"ramp of {text}"] = (value / float(ramp[1]), error / float(ramp[1]))
        elif wave is not None:
            found[wave[1]] = (value, error)
            found["middle"] = (-float(wave[2] or 0), 0.0)
        else:
            found[NAMED.get(label, label if label.startswith("step of ") else "coefficient")] = (value, error)
    return found


def residual(fitted: Fitted, noise: Float[ndarray, " sites"]) -> float:
    """Return the root mean square of what a fit leaves of the readings, those of each sensor over its noise."""
    left = np.concatenate([(one.seen - one.level)[:, 0, 0] for one in fitted.curves()]) / noise
    read = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(read**2))) if len(read) else float("nan")


def written(recording: LabRecording) -> list[dict[str, Any]]:
    """Return what is in a recording as JSON can hold it."""
    return [
        {
            "name": one.name, "site": one.site, "parameters": dict(one.parameters), "z": one.z, "apart": one.apart,
            "alike": list(one.alike), "sites": list(one.sites), "beside": dict(one.beside),
        }
        for one in recording.effects
    ]  # fmt: skip


def matched(truth: Sequence[Mapping[str, Any]], found: Sequence[Finding], *, alike: bool = False) -> list[int | None]:
    """Return which finding names each effect, as many effects as possible being named; None for none.

    Args:
        truth: effects, as `written` gives them.
        found: by the diagnosis.
        alike: count an effect that does the same in these readings as the effect itself.
    """
    wanted = [{one["name"], *(one["alike"] if alike else ())} for one in truth]
    # Whether it is named by its own name, by its group, or not.
    worth = np.array([
        [0.0 if not one & each.group else 1.01 if truth[k]["name"] == each.name else 1.0 for each in found]
        for k, one in enumerate(wanted)
    ]).reshape(len(truth), len(found))  # fmt: skip
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-worth)
    pairs = {int(k): int(j) for k, j in zip(rows, columns, strict=True) if worth[k, j] > 0}
    return [pairs.get(k) for k in range(len(truth))]


@dataclass(frozen=True)
class Judgement:
    """What a diagnosis is worth.

    Attributes:
        named: effects that were named, each once.
        missed: effects that were not.
        invented: what was found that is not there.
        right: whether nothing was missed or invented.
        right_alike: the same where effects that do the same in these readings count as one.
        placed: of the effects at one site that were named, how many at a site where they do
            the same, and how many there are.
        covered: of the parameters of effects found by name and place, how many 95 % intervals hold the true value, and
            how many there are.
    """

    named: tuple[str, ...]
    missed: tuple[str, ...]
    invented: tuple[str, ...]
    right: bool
    right_alike: bool
    placed: tuple[int, int]
    covered: tuple[int, int]


def judge(truth: Sequence[Mapping[str, Any]], found: Sequence[Finding], instrument: str = "") -> Judgement:
    """Return how well findings agree with what is in a recording.

    Args:
        truth: effects, as `written` gives them.
        found: by the diagnosis.
        instrument: its kind; what that does by itself is not invented, and need not be found.
    """
    found = [one for one in found if one.name not in OF_INSTRUMENT.get(instrument, ())]
    pairs = matched(truth, found)
    named = tuple(one["name"] for one, j in zip(truth, pairs, strict=True) if j is not None)
    missed = tuple(one["name"] for one, j in zip(truth, pairs, strict=True) if j is None)
    invented = _beyond(truth, found, pairs)
    loose = matched(truth, found, alike=True)
    right_alike = None not in loose and not _beyond(truth, found, loose)
    placed, covered, unit, others = [], [], _unit(truth, found, pairs), _others(truth, found, pairs)
    for one, j in zip(truth, pairs, strict=True):
        if j is None or found[j].name != one["name"]:
            continue
        if one["site"] is not None:
            placed.append(found[j].site in one["sites"])
        if _of_sensors(one["name"]) not in others:
            values = _together(found, j)
            covered += list(_intervals(_said_in(unit, one, values), values))
    return Judgement(
        named, missed, invented, not missed and not invented, right_alike, (sum(placed), len(placed)),
        (sum(covered), len(covered)),
    )  # fmt: skip


def _of_sensors(name: str) -> bool:
    return name.startswith("sensor-")


def _others(
    truth: Sequence[Mapping[str, Any]], found: Sequence[Finding], pairs: Sequence[int | None]
) -> frozenset[bool]:
    """Return the sides, sensors (True) or forces, on which another effect or place is named for a true one."""
    sides: set[bool] = set()
    for one, j in zip(truth, pairs, strict=True):
        if j is None or (found[j].name == one["name"] and one["name"] in ONE_FOR_ALL and _alike(one, found, j)):
            continue
        if (found[j].name, found[j].site) != (one["name"], one["site"]):
            sides |= {_of_sensors(one["name"]), _of_sensors(found[j].name)}
    return frozenset(sides)


def _alike(one: Mapping[str, Any], found: Sequence[Finding], j: int) -> bool:
    """Return whether the sensors' numbers mean the same in the truth and in what is found: curves are those of one."""
    return one["name"] != "sensor-curve" or set(one["parameters"]) == set(_together(found, j))


def _unit(truth: Sequence[Mapping[str, Any]], found: Sequence[Finding], pairs: Sequence[int | None]) -> float:
    """Return the unit of u in the truth over that of what is found: the true gain of the sensor that is taken as right.

    It is 1 unless one gain of the truth is not found, and those of all other sensors are, or one that does the same.
    """
    for one, j in zip(truth, pairs, strict=True):
        if j is None or not one["name"] == found[j].name == "sensor-gain":
            continue
        missing = [value for name, value in one["parameters"].items() if name not in _together(found, j)]
        if len(missing) == 1 and (len(found[j].values) > 1 or found[j].site in one["sites"]):
            return float(missing[0])
    return 1.0


def _said_in(unit: float, one: Mapping[str, Any], values: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Return the true parameters of an effect as those that are found count them: from the same zeros, in that unit.

    The phase of a drive is that at the time from which what was found counts.
    """
    true, beside = dict(one["parameters"]), one.get("beside") or {}
    # No outer sensor is named: their zeros are taken as right.
    if beside and not any(name in values for name in true if name not in beside):
        true = dict(beside)
    if unit != 1 and one["name"] == "sensor-gain":
        true = {name: true.get(name, 1.0) for name in values}
    if "middle" in values and "omega" in true:
        phase = true["omega"] * values["middle"][0]
        cos, sin = true["cos"], true["sin"]
        true["cos"], true["sin"] = cos * np.cos(phase) + sin * np.sin(phase), sin * np.cos(phase) - cos * np.sin(phase)
    factor = unit ** POWERS.get(one["name"], 0)
    return {name: value if name == "omega" else value * factor for name, value in true.items()}


def _beyond(
    truth: Sequence[Mapping[str, Any]], found: Sequence[Finding], pairs: Sequence[int | None]
) -> tuple[str, ...]:
    """Return the names of findings that are not there."""
    spare = [one for j, one in enumerate(found) if j not in pairs]
    there = {one["name"] for one in truth}
    # A curve of one sensor besides that of all is another one.
    every = {one.name for one in found if "curve" in one.values}
    return tuple(one.name for one in spare if one.name in every or one.name not in there.intersection(ONE_FOR_ALL))


def _together(found: Sequence[Finding], j: int) -> dict[str, tuple[float, float]]:
    """Return the values of a finding, with those of all of its name where they are one effect."""
    if found[j].name not in ONE_FOR_ALL:
        return dict(found[j].values)
    alike = (one.values.items() for one in found if one.name == found[j].name)
    return dict(itertools.chain.from_iterable(alike))


def _intervals(parameters: Mapping[str, float], values: Mapping[str, tuple[float, float]]) -> list[bool]:
    """Return whether each interval that is given holds the true value."""
    return [
        abs(values[name][0] - true) <= HALF * values[name][1]
        for name, true in parameters.items()
        if name in values and np.isfinite(values[name][1]) and values[name][1] > 0
    ]


def found_in(result: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings of a stored result."""
    found = []
    for one in result["findings"]:
        values = {name: (value, np.nan if error is None else error) for name, (value, error) in one["values"].items()}
        found.append(Finding(one["name"], one["site"], values, tuple(one["alternatives"])))
    return tuple(found)
