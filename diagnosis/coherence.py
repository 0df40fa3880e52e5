"""Whether anything at all is left: noise is not correlated in time or along the chain, and has no reading far out.

The residual r, in units of the noise and free of what the model can do, stands on its lattice of times and sites. With
G a bell of some width in samples and some in sites, q = r G r / r r is larger than for noise where neighbours in the
residual agree: a portmanteau test (Box & Pierce, J. Amer. Statist. Assoc. 65, 1509 (1970)), which needs neither a form
nor the noise's size. The null distribution of q is simulated as that of the effects is (`diagnosis.trace`); its tail is
that of the gamma distribution with the same mean and variance (q, with the bell's own middle in it, is never negative).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage, stats

from latticebench.diagnosis.candidate import UNNAMED
from latticebench.diagnosis.trace import CHUNK, Screened, surrogate_residuals

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.tangent import Tangent

# Widths of the bell in samples and in sites.
IN_TIME, ALONG = (0.0, 0.8, 1.6, 4.0), (0.0, 0.8, 2.0)
NAMES = {
    (True, False): "something of any form that goes on in time",
    (False, True): "something of any form that goes on along the chain",
    (True, True): "something of any form that goes on in time and along the chain",
}


def coherence(tangent: Tangent, draw: np.random.Generator, surrogates: int = 200) -> Screened:
    """Return the agreement of neighbours that noise alone would show least often; its `rarity` counts all widths."""
    sites = tangent.paths[0].record.stretches.dynamics.sites
    widths = [(a, b) for a in IN_TIME for b in ALONG if (a or b) and (sites > 1 or not b)]
    own = _agreement(tangent, tangent.residual[:, None], widths)[:, 0]
    chunk, null, done = max(1, min(surrogates, CHUNK // len(tangent.residual))), [], 0
    while done < surrogates:
        noise = surrogate_residuals(tangent, draw, min(chunk, surrogates - done))
        done += noise.shape[1]
        null.append(_agreement(tangent, noise, widths))
    every = np.concatenate(null, axis=1)
    mean, variance = np.mean(every, axis=1), np.var(every, axis=1, ddof=1)
    rare = -stats.gamma.logsf(own, mean**2 / variance, scale=variance / mean)
    best = int(np.argmax(rare))
    gain = float(min(stats.chi2.isf(np.exp(-rare[best]), 1), 2 * rare[best]))
    name = NAMES[widths[best][0] > 0, widths[best][1] > 0]
    # Far out, where it matters, the widths are as good as independent, however alike they are near the middle.
    count = float(len(widths))
    return Screened(name, UNNAMED, gain, 1, count, float(np.log(count)), named=False)


def farthest(tangent: Tangent) -> Screened:
    """Return the reading that is farthest out, in units of what is left of all.

    Its `rarity` says how rarely Gaussian noise has such a one.
    """
    away = tangent.residual**2 * tangent.spare / np.sum(tangent.residual**2)
    sites = np.concatenate([np.nonzero(path.weight > 0)[-1] for path in tangent.paths])
    first = int(np.argmax(away))
    count = float(len(away))
    return Screened(
        "single readings far out",
        replace(UNNAMED, site=int(sites[first])),
        float(away[first]),
        1,
        count,
        float(np.log(count)),
        named=False,
    )


def _agreement(
    tangent: Tangent, residuals: Float[ndarray, "rows draws"], widths: list[tuple[float, float]]
) -> Float[ndarray, "widths draws"]:
    """Return q for each width and draw (widths, draws)."""
    total = np.zeros((len(widths), residuals.shape[1]))
    begin = 0
    for path in tangent.paths:
        seen = path.weight > 0
        end = begin + int(np.sum(seen))
        field = np.zeros((residuals.shape[1], *seen.shape))
        field[:, seen] = residuals[begin:end].T
        for k, (a, b) in enumerate(widths):
            smooth = ndimage.gaussian_filter(field, (0, a, 0, 0, b), mode="constant")
            total[k] += np.sum(field * smooth, axis=(1, 2, 3, 4))
        begin = end
    return np.asarray(total / np.sum(residuals**2, axis=0))
