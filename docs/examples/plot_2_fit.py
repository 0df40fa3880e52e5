"""
Readings with a fit on top
==========================

The weak form finds the four coefficients of the phi^4 lattice from readings with 2 % noise. What its equation leaves of
the readings has no pattern, and its spectrum is flat: it is noise.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from latticebench import methods, systems
from latticebench.bench.overlay import of_fit
from latticebench.bench.plots import plot
from latticebench.methods.method import make, solve
from latticebench.systems.simulate import observe, simulate

phi4 = systems.find("phi4")
clean = simulate(phi4, sites=21)
samples = replace(observe(clean, np.random.default_rng(1), noise=0.02), ends=phi4.ends)
fit = solve(make(methods.find("weak"), {}), [samples], phi4.library("lib2"), order=2, seed=1)
for term, value, error in zip(fit.library.texts, fit.coefficients, fit.stderr, strict=True):
    print(f"{term:10} {value:7.3f} +- {error:.3f}")

plot(of_fit([samples], fit), figure=plt.figure())
