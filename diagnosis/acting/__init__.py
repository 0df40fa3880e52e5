"""Ways of acting, one file each: where an effect may be, what it does to motion or readings, and how it is said."""

import importlib
import pkgutil

from latticebench.diagnosis.acting.placed import (
    WAYS,
    AtOneSite,
    Force,
    InStep,
    Misreading,
    OfSensors,
    Placed,
    Summand,
    way_of,
)
from latticebench.diagnosis.acting.scene import Chain, Scene

# Every file of this folder makes its way of acting known.
for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "WAYS", "AtOneSite", "Chain", "Force", "InStep", "Misreading", "OfSensors", "Placed", "Scene", "Summand", "way_of",
]  # fmt: skip
