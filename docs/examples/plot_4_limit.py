"""
What a longer record buys
=========================

The bound of each coefficient against the length of the record, with 1 % noise and five samples a unit of time. It falls
faster than with the square root of the length, because a longer motion also shows more states.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from latticebench import systems
from latticebench.bench.colours import series
from latticebench.bench.limit import bound_of
from latticebench.systems.simulate import simulate

phi4 = systems.find("phi4")
library = phi4.library("lib2")
spans = [1, 2, 4, 8, 16]
bounds = []
for span in spans:
    clean = replace(simulate(phi4, sites=15, times=np.arange(5 * span) / 5), ends=phi4.ends)
    bounds.append(bound_of([clean], library, 2, noise=0.01).stderr)

figure, axes = plt.subplots(layout="constrained")
for place, (term, curve) in enumerate(zip(library.texts, np.transpose(bounds), strict=True)):
    axes.loglog(spans, curve, "os^D"[place] + "-", color=series(place), label=term)
axes.set(xlabel="length of the record", ylabel="smallest standard error")
axes.legend()
