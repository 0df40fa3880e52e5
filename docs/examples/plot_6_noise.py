"""
What noise leaves to be known
=============================

The Cramer-Rao bound on the relative error of all coefficients against the noise, for the four libraries of the phi^4
lattice. Along such a motion the cubic terms of `lib4` are nearly the same: with 1 % noise its coefficients can be known
to a tenth, those of the others to a thousandth, whatever the method.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from latticebench import systems
from latticebench.bench.colours import series
from latticebench.bench.limit import bound_of
from latticebench.systems.simulate import simulate

phi4 = systems.find("phi4")
clean = replace(simulate(phi4, sites=15), ends=phi4.ends)
levels = np.geomspace(1e-3, 0.1, 9)

figure, axes = plt.subplots(layout="constrained")
for place, name in enumerate(["lib1", "lib2", "lib3", "lib4"]):
    library = phi4.library(name)
    limit = bound_of([clean], library, 2, noise=0.01)
    errors = [limit.at(level).relative for level in levels]
    axes.loglog(levels, errors, "os^D"[place] + "-", color=series(place), label=f"{name}, {len(library.terms)} terms")
    print(f"{name}: {limit.at(0.01).relative:.2%} with 1 % noise")
axes.axhline(1, color="k", lw=0.8)
axes.set(xlabel="noise over the RMS of the field", ylabel="smallest relative error, E2")
axes.legend()
