"""
Published tables
================

`results` reads published tables as pandas DataFrames. Here: how many times the Cramer-Rao bound the errors of each
method of the suite `limits` are with 1 % noise, over all lattices, with the lattice's own terms.
"""

import matplotlib.pyplot as plt

import latticebench as lb
from latticebench.bench.colours import series

tables = lb.results("limits")
print({name: frame.shape for name, frame in tables.items()})

fits = tables["summary"]
fits = fits[fits["data"].str.contains("noise=0.01") & (fits["part"] == "noise") & (fits["method"] != "zero")]
# Of each lattice the library with the fewest terms, whose bound is the lowest.
fits = fits[fits["bound"] == fits.groupby("data")["bound"].transform("min")]
ratio = (fits["e2"] / fits["bound"]).groupby(fits["method"])
table = ratio.describe()[["count", "min", "50%", "max"]].sort_values("50%")
print(table.round(2))

figure, axes = plt.subplots(layout="constrained")
for place, name in enumerate(table.index):
    found = ratio.get_group(name)
    axes.semilogx(found, [place] * len(found), "o", color=series(place), ms=7)
axes.set_yticks(range(len(table)), table.index)
axes.axvline(1, color="k", ls="--", lw=1)
axes.invert_yaxis()
axes.set_xlabel("E2 over the Cramer-Rao bound, one point per lattice")
