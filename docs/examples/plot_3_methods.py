"""
Methods against the limit
=========================

The relative error of three methods against the noise, beside the Cramer-Rao bound, which no method can beat on average.
Regression on derivatives is far from it: differentiating amplifies noise.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from latticebench import methods, systems
from latticebench.bench.colours import series
from latticebench.bench.limit import bound_of
from latticebench.methods.method import make, solve
from latticebench.systems.simulate import observe, simulate

phi4 = systems.find("phi4")
library = phi4.library("lib2")
clean = replace(simulate(phi4, sites=15), ends=phi4.ends)
truth = clean.truth(library)
levels = np.array([0.001, 0.003, 0.01, 0.03])

figure, axes = plt.subplots(layout="constrained")
for place, name in enumerate(["least-squares", "weak", "trajectory"]):
    found = [
        solve(make(methods.find(name), {}), [observe(clean, np.random.default_rng(2), noise=level)], library, 2, 1)
        for level in levels
    ]
    errors = [np.linalg.norm(fit.coefficients - truth) / np.linalg.norm(truth) for fit in found]
    axes.loglog(levels, errors, "os^"[place] + "-", color=series(place), label=name)
limit = bound_of([clean], library, 2, noise=0.01)
axes.loglog(levels, [limit.at(level).relative for level in levels], "k--", label="Cramer-Rao bound")
axes.set(xlabel="noise over the RMS of the field", ylabel="relative error of the coefficients, E2")
axes.legend()
