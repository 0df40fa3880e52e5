"""Effects as they are put into simulated recordings, to see whether the diagnosis finds them.

A fault is the simulation of an effect, of the catalogue or from outside it. It shares no code with the diagnosis: plain
NumPy forces beside the system's own right-hand side, SciPy's integrators, and what is wrong with the instrument put on
afterwards. Five sets from outside the catalogue are blind: they were written without knowledge of the diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from latticebench.bench.trials.faults import instrument, pushes, unseen
from latticebench.bench.trials.faults.pushes import PUSHES, push
from latticebench.bench.trials.faults.setting import Fields, Setting
from latticebench.systems.effects import find
from latticebench.systems.lattice import System
from latticebench.systems.terms import Term, express

NONE = "none"


@dataclass(frozen=True)
class Fault:
    """The simulation of one effect.

    Attributes:
        fields: from a setting and an amount to the clean readings.
        only: where it makes sense: on lattices of second order, for complex or for real fields, or everywhere (None).
        real: whether its amount is a real number for complex fields, too.
        sized: whether there can be more or less of it.
    """

    fields: Callable[[Setting, complex], Fields]
    only: Literal["second order", "complex", "real"] | None = None
    real: bool = False
    sized: bool = True

    def fits(self, system: System) -> bool:
        """Return whether a system can have it."""
        if self.only is None:
            return True
        if self.only == "second order":
            return system.order == 2
        return system.is_complex == (self.only == "complex")


def _pushed(name: str, only: Literal["second order", "complex"] | None = None, *, real: bool = False) -> Fault:
    return Fault(lambda setting, amount: setting.run(push(setting, {name: amount})), only, real)


def _misread(function: Callable[[Setting, float], Fields]) -> Fault:
    return Fault(lambda setting, amount: function(setting, float(np.real(amount))), real=True)


SECOND_ORDER = (
    "other: cubic-drag",
    "other: wavy-drag",
    # For order 1 this would be disorder, and the next one asymmetric coupling.
    "other: absorbing-ends",
    "other: gyroscopic-bonds",
    "onsite-bilinear",
    "local-bilinear",
    "local-friction",
    "bilinear-coupling",
)
COMPLEX = ("other: phase-conjugation", "other: nonlocal-response")
REAL = (
    "damping",
    "bond-damping",
    "nonlinear-damping",
    "nonlinear-loss",
    "gain-loss",
    "disorder",
    "coefficient-drift",
    "coefficient-jump",
)


def _pushing(names: dict[str, Callable[[pushes.Moment], np.ndarray]]) -> dict[str, Fault]:
    return {
        name: _pushed(
            name, "second order" if name in SECOND_ORDER else "complex" if name in COMPLEX else None, real=name in REAL
        )
        for name in names
    }


# Of the instrument: they can be there beside what pushes the chain.
MISREADINGS = {
    "sensor-offset": _misread(instrument.offset),
    "sensor-gain": _misread(instrument.gain),
    "sensor-curve": _misread(instrument.curve),
    "sensor-saturation": _misread(instrument.lens),
    "sensor-drift": _misread(instrument.drift),
    "sensor-jump": _misread(instrument.knocked),
    "sensor-wander": _misread(instrument.wander),
    "sensor-hum": _misread(instrument.humming),
    "sensor-lag": replace(_misread(instrument.slow), only="second order"),
    "sensor-cyclic": replace(_misread(instrument.cyclic), only="real"),
    "sensor-gain-drift": _misread(instrument.fading),
    "sensor-gain-jump": _misread(instrument.switched),
    "sensor-crosstalk": _misread(instrument.crosstalk),
    "sensor-imbalance": replace(_misread(instrument.unbalanced), only="complex"),
    "sensor-clock": replace(_misread(instrument.own_clock), only="second order"),
    "clock-jump": replace(_misread(instrument.dropped), only="second order"),
    # Where only u is read, another unit of time does the same.
    "clock": replace(_misread(instrument.slow_clock), only="second order"),
}
CATALOGUED = {
    **_pushing(pushes.CATALOGUED),
    **MISREADINGS,
    "ends": Fault(unseen.ends, real=True, sized=False),
    "unequal-masses": Fault(unseen.unequal_masses, real=True),
    "known-input": Fault(unseen.known_input),
    "memory": Fault(unseen.memory),
    "side-mass": Fault(unseen.side_mass, "second order", real=True),
    "swaying-support": Fault(unseen.swaying_support, "second order", real=True),
}
BLIND = {
    **_pushing(pushes.FIRST_BLIND),
    "other: side-resonator": Fault(unseen.side_resonator),
    "other: retarded-coupling": Fault(unseen.retarded_coupling),
    "other: drifting-sensor": _misread(instrument.drifting),
    "other: neighbour-crosstalk": _misread(instrument.crosstalk),
    "other: slow-sensor": _misread(instrument.slow),
    "other: clipped-reading": _misread(instrument.clipped),
}
SECOND_BLIND = {
    **_pushing(pushes.SECOND_BLIND),
    "other: slow-heating": Fault(unseen.slow_heating),
    "other: slipping-spring": Fault(unseen.slipping_spring, "second order"),
    "other: shared-inertia": Fault(unseen.shared_inertia, real=True),
    "other: scanned-channels": _misread(instrument.scanned),
    "other: mains-hum": _misread(instrument.hum),
    "other: slack-needle": _misread(instrument.slack),
}
THIRD_BLIND = {
    **_pushing(pushes.THIRD_BLIND),
    "other: end-stops": Fault(unseen.end_stops),
    "other: swaying-mount": Fault(unseen.swaying_mount),
    "other: flickering-lamp": _misread(instrument.flickering),
    "other: averaging-readout": _misread(instrument.averaged),
    "other: floating-ground": _misread(instrument.grounded),
}
FOURTH_BLIND = {
    **_pushing(pushes.FOURTH_BLIND),
    "other: inner-resonators": Fault(unseen.inner_resonators),
    "other: tilted-camera": _misread(instrument.tilted),
    "other: stray-spikes": _misread(instrument.spiked),
    "other: ac-coupling": _misread(instrument.blocked),
}
FIFTH_BLIND = {
    **_pushing(pushes.FIFTH_BLIND),
    "other: viscoelastic-bonds": Fault(unseen.viscoelastic_bonds),
    "other: fatiguing-bonds": Fault(unseen.fatiguing_bonds),
    "other: holding-loop": Fault(unseen.holding_loop),
    "other: parallel-chain": Fault(unseen.parallel_chain),
    "other: bent-wire": Fault(unseen.bent_wire, "second order"),
    "other: converter-residue": _misread(instrument.residue),
    "other: cyclic-error": _misread(instrument.cyclic),
    "other: auto-exposure": _misread(instrument.exposed),
    "other: wandering-reference": _misread(instrument.wandering),
    "other: two-cards": _misread(instrument.two_cards),
    "other: mixer-imbalance": replace(_misread(instrument.unbalanced), only="complex"),
    "other: resampled-rows": _misread(instrument.resampled),
}
PLAIN = {**_pushing(pushes.PLAIN), "other: jittered-rows": _misread(instrument.jitter)}
OTHERS = {**PLAIN, **BLIND, **SECOND_BLIND, **THIRD_BLIND, **FOURTH_BLIND, **FIFTH_BLIND}
FAULTS = {**CATALOGUED, **OTHERS}


def sensible(name: str, system: System) -> bool:
    """Return whether an effect makes sense for a system, and its declared equation lacks it."""
    if name in OTHERS:
        return OTHERS[name].fits(system)
    effect = find(name)
    texts = effect.texts(system.order, system.is_complex)
    if not texts or not FAULTS[name].fits(system) or (name == "known-input" and system.is_complex):
        return False
    if not effect.is_a_term:
        return True
    declared = system.library("equation").terms
    return any(express(Term(text), declared, system.is_complex) is None for text in texts)


__all__ = [
    "BLIND",
    "FAULTS",
    "FIFTH_BLIND",
    "FOURTH_BLIND",
    "MISREADINGS",
    "NONE",
    "OTHERS",
    "PUSHES",
    "SECOND_BLIND",
    "THIRD_BLIND",
    "Fault",
    "push",
    "sensible",
]
