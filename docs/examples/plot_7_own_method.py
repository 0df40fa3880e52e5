"""
A method of one's own
=====================

A method is one file. Ridge regression (:download:`ridge.py <../data/ridge.py>`) gets the same samples, library and
seeds as two others; its penalty does not help where the error comes from differentiating noise.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from latticebench import methods, systems
from latticebench.bench.colours import series
from latticebench.methods.method import make, solve
from latticebench.systems.simulate import observe, simulate

phi4 = systems.find("phi4")
library = phi4.library("lib2")
clean = replace(simulate(phi4, sites=15), ends=phi4.ends)
truth = clean.truth(library)
levels, seeds = np.array([0.001, 0.003, 0.01, 0.03]), range(1, 8)


def error(name, level, seed):
    """Return the relative error of a method's coefficients."""
    samples = observe(clean, np.random.default_rng(seed), noise=level)
    fit = solve(make(methods.find(name), {}), [samples], library, 2, seed)
    return np.linalg.norm(fit.coefficients - truth) / np.linalg.norm(truth)


figure, axes = plt.subplots(layout="constrained")
for place, name in enumerate(["../data/ridge.py", "stlsq", "weak"]):
    errors = np.array([[error(name, level, seed) for seed in seeds] for level in levels])
    low, middle, high = np.quantile(errors, [0.1, 0.5, 0.9], axis=1)
    label = name.removeprefix("../data/").removesuffix(".py")
    axes.loglog(levels, middle, "os^"[place] + "-", color=series(place), label=label)
    axes.fill_between(levels, low, high, color=series(place), alpha=0.2)
axes.set(xlabel="noise over the RMS of the field", ylabel="E2, median and middle 80 % of seven seeds")
axes.legend()
