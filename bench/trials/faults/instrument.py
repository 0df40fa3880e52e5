"""Errors of the instrument: the chain moves as declared, and the readings are wrong.

Each function returns the clean readings with an error of the given size, a real number. A complex field's parts are
read alike. Velocities are wrong as the field is, unless a function says otherwise: they then have sensors of their own,
which are sound.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults.setting import FINE, Fields, Setting

if TYPE_CHECKING:
    from numpy import ndarray

# Points that a mean over a time is taken from.
AVERAGED = 8


def offset(setting: Setting, size: float) -> Fields:
    """Lift one site's readings of u."""
    u, v = setting.run()
    return u + size * setting.one, v


def gain(setting: Setting, size: float) -> Fields:
    """Scale one site's readings."""
    return _with_scale(setting.run(), 1 + size * setting.one)


def fading(setting: Setting, size: float) -> Fields:
    """Let the gain of one sensor change steadily, by the size over the record."""
    along = (setting.times - setting.times[0]) / (setting.times[-1] - setting.times[0])
    return _with_scale(setting.run(), 1 + size * along[:, None] * setting.one)


def switched(setting: Setting, size: float) -> Fields:
    """Change the gain of one sensor at one time."""
    after = (setting.times > setting.drawn.about["at"])[:, None]
    return _with_scale(setting.run(), 1 + size * after * setting.one)


def curve(setting: Setting, size: float) -> Fields:
    """Bend the scale: u + size u^2, of a complex field u + size |u| u."""
    u, v = setting.run()
    bent = u + size * (np.abs(u) if np.iscomplexobj(u) else u) * u
    return bent, None if v is None else v * (1 + 2 * size * u)


def lens(setting: Setting, size: float) -> Fields:
    """Compress or stretch the scale at both ends: u + size u^3, of a complex field u + size |u|^2 u."""
    u, v = setting.run()
    return u + size * np.abs(u) ** 2 * u, None if v is None else v * (1 + 3 * size * u**2)


def knocked(setting: Setting, size: float) -> Fields:
    """Move the zero of one sensor of u at one time."""
    u, v = setting.run()
    return u + size * (setting.times > setting.drawn.about["at"])[:, None] * setting.one, v


def drift(setting: Setting, size: float) -> Fields:
    """Move the zero of one sensor of u steadily, by the size over the record."""
    u, v = setting.run()
    along = (setting.times - setting.times[0]) / (setting.times[-1] - setting.times[0])
    return u + size * along[:, None] * setting.one, v


def wander(setting: Setting, size: float) -> Fields:
    """Let the zero of one sensor of u wander at random, by small steps."""
    u, v = setting.run()
    return u + size * setting.drawn.wander[:, None] * setting.one, v


def humming(setting: Setting, size: float) -> Fields:
    """Let one sensor of u hum."""
    u, v = setting.run()
    about = setting.drawn.about
    return u + size * np.cos(about["hum"] * setting.times + about["hum_phase"])[:, None] * setting.one, v


def slow_clock(setting: Setting, size: float) -> Fields:
    """Read each row late by a share of the time since the first."""
    begin = setting.times[0]
    return setting.at(begin + (1 + size) * (setting.times - begin)).run()


def own_clock(setting: Setting, size: float) -> Fields:
    """Read one site of u by a clock that is slow by the size, and right at the start."""
    begin = setting.times[0]
    u, v = setting.run()
    late, _ = setting.at(begin + (1 - size) * (setting.times - begin)).run()
    return u + (late - u) * setting.one, v


def dropped(setting: Setting, size: float) -> Fields:
    """Read each row of a while later, from one time on."""
    return setting.at(setting.times + size * (setting.times > setting.drawn.about["at"])).run()


def jitter(setting: Setting, size: float) -> Fields:
    """Read each row a little late or early, within the record."""
    times, drawn = setting.times, setting.drawn
    at = np.clip(times + size * drawn.late, times[0], times[-1])
    grid, place = np.unique(np.concatenate([times[[0, -1]], at]), return_inverse=True)
    u, v = setting.at(grid).run()
    rows = place[2:]
    return u[rows], None if v is None else v[rows]


def drifting(setting: Setting, size: float) -> Fields:
    """Let one sensor of u warm up."""
    u, v = setting.run()
    drift = 1 - np.exp(-(setting.times - setting.times[0]) / setting.drawn.about["warming"])
    return u + size * drift[:, None] * setting.one, v


def crosstalk(setting: Setting, size: float) -> Fields:
    """Mix readings of sensors side by side, of which those at the ends have one neighbour."""
    u, v = setting.run()
    beside = np.eye(u.shape[1], k=1) + np.eye(u.shape[1], k=-1)
    return u + size * u @ beside, None if v is None else v + size * v @ beside


def slow(setting: Setting, size: float) -> Fields:
    """Let one sensor of u follow the field with y' = (u - y) / size.

    Between the steps of a fine grid the field is taken as straight, for which this is exact.
    """
    fine, site = setting.fine(), setting.drawn.site
    u, v = fine.run()
    seen, shown = u[:, site], u[:, site].copy()
    for k, step in enumerate(np.diff(fine.times)):
        behind = size * (seen[k + 1] - seen[k]) / step
        shown[k + 1] = seen[k + 1] - behind + (shown[k] - seen[k] + behind) * np.exp(-step / size)
    u[:, site] = shown
    return u[::FINE], None if v is None else v[::FINE]


def clipped(setting: Setting, size: float) -> Fields:
    """Clip all sensors of u to one range, for each part of a complex field."""
    u, v = setting.run()
    # The root, as what is lost grows faster than the range shrinks.
    limit = max(np.max(np.abs(u.real)), np.max(np.abs(u.imag))) / (1 + np.sqrt(size))
    if np.iscomplexobj(u):
        return np.clip(u.real, -limit, limit) + 1j * np.clip(u.imag, -limit, limit), v
    return np.clip(u, -limit, limit), v


def scanned(setting: Setting, size: float) -> Fields:
    """Read the sites in turn with one instrument, the last one `size` after the first."""
    sites = np.arange(setting.chain.sites)
    at = setting.times[:, None] + size * sites / max(setting.chain.sites - 1, 1)
    grid, place = np.unique(at, return_inverse=True)
    u, v = setting.at(grid).run()
    rows = place.reshape(at.shape)
    return u[rows, sites], None if v is None else v[rows, sites]


def hum(setting: Setting, size: float) -> Fields:
    """Let the mains hum in step in all wires for u, of which some catch more."""
    u, v = setting.run()
    drawn = setting.drawn
    beat = np.cos(drawn.about["hum"] * setting.times + drawn.about["hum_phase"])
    return u + size * beat[:, None] * drawn.pickup, v


def slack(setting: Setting, size: float) -> Fields:
    """Show u by needles that stay where they are until it is `size` away, and are then dragged along.

    They start where the field is; each part of a complex field has its own.
    """
    chain = setting.chain
    u, v = setting.fine().run()
    parts = np.stack([u.real, u.imag]) if chain.is_complex else u[None]
    shown = parts.copy()
    for k in range(1, len(u)):
        shown[:, k] = np.clip(shown[:, k - 1], parts[:, k] - size, parts[:, k] + size)
    read = shown[0] + 1j * shown[1] if chain.is_complex else shown[0]
    return read[::FINE], None if v is None else v[::FINE]


def flickering(setting: Setting, size: float) -> Fields:
    """Light all sites with one lamp that flickers."""
    return _with_scale(setting.run(), (1 + size * setting.drawn.flicker)[:, None])


def averaged(setting: Setting, size: float) -> Fields:
    """Read means over a time that begins with each sample's, by Gauss's rule."""
    # The root, as a mean over a time is off by its square but for a shift, which is as good as another start.
    over = float(np.sqrt(size))
    nodes, weights = np.polynomial.legendre.leggauss(AVERAGED)
    at = setting.times[:, None] + over * (1 + nodes) / 2
    grid, place = np.unique(np.concatenate([setting.times[:1], at.ravel()]), return_inverse=True)
    u, v = setting.at(grid).run()
    rows = place[1:].reshape(at.shape)
    share = weights[:, None] / 2
    return np.sum(share * u[rows], axis=1), None if v is None else np.sum(share * v[rows], axis=1)


def grounded(setting: Setting, size: float) -> Fields:
    """Measure all sites against a ground that is itself lifted by their mean."""
    u, v = setting.run()
    return _lowered(u, size), None if v is None else _lowered(v, size)


def tilted(setting: Setting, size: float) -> Fields:
    """Watch the chain with a tilted camera: the scale grows from one end to the other by 2 size of its mean."""
    n = setting.drawn.n
    return _with_scale(setting.run(), 1 + size * n / np.max(n))


def spiked(setting: Setting, size: float) -> Fields:
    """Let a few readings of u be off by about the size, up or down."""
    u, v = setting.run()
    return u + size * setting.drawn.spikes, v


def blocked(setting: Setting, size: float) -> Fields:
    """Lead all sensors of u through capacitors, y' = u' - size y, which let what is constant fade.

    They are uncharged at the start. Between the steps of a fine grid the field is taken as straight, for which this is
    exact.
    """
    fine = setting.fine()
    u, v = fine.run()
    shown = u.copy()
    for k, step in enumerate(np.diff(fine.times)):
        gone = -np.expm1(-size * step)
        shown[k + 1] = shown[k] * (1 - gone) + (u[k + 1] - u[k]) * gone / (size * step)
    return shown[::FINE], None if v is None else v[::FINE]


def residue(setting: Setting, size: float) -> Fields:
    """Scan all sites, row by row, with one converter that keeps a share of its last reading.

    That is y = (1 - size) u + size y_before. Before the first site of a row it has read the last one of the row before.
    """
    u, v = setting.run()
    return _kept(u, size), None if v is None else _kept(v, size)


def cyclic(setting: Setting, size: float) -> Fields:
    """Read u with an interferometer, whose error repeats with its fringes: u + size sin(2 pi u / cycle)."""
    u, v = setting.run()
    turn = 2 * np.pi / float(setting.drawn.about["cycle"])
    if np.iscomplexobj(u):
        return u + size * (np.sin(turn * u.real) + 1j * np.sin(turn * u.imag)), v
    return u + size * np.sin(turn * u), v


def exposed(setting: Setting, size: float) -> Fields:
    """Let a camera for u expose by the mean b of |u| in the row before: u (1 - size (b / b_first - 1))."""
    u, v = setting.run()
    bright = np.mean(np.abs(u), axis=1)
    # The first row is exposed as it should be.
    before = np.concatenate([bright[:1], bright[:-1]])
    return u * (1 - size * (before / bright[0] - 1))[:, None], v


def wandering(setting: Setting, size: float) -> Fields:
    """Let the reference that all sensors of u are read against wander at random, by small steps."""
    u, v = setting.run()
    step = size * setting.drawn.wander[:, None]
    return u + (step * (1 + 1j) if np.iscomplexobj(u) else step), v


def two_cards(setting: Setting, size: float) -> Fields:
    """Read the right half with a second card whose clock is slow: its rows are taken at t + size (t - t_first)."""
    times, half = setting.times, setting.chain.sites // 2
    at = np.stack([times, times + size * (times - times[0])])
    grid, place = np.unique(at, return_inverse=True)
    u, v = setting.at(grid).run()
    first, second = place.reshape(at.shape)

    def joined(field: ndarray) -> ndarray:
        return np.concatenate([field[first, :half], field[second, half:]], axis=1)

    return joined(u), None if v is None else joined(v)


def unbalanced(setting: Setting, size: float) -> Fields:
    """Read a complex field with two mixers of unequal gain, so that its mirror image appears: u + size conj(u)."""
    u, v = setting.run()
    return u + size * np.conj(u), None if v is None else v + size * np.conj(v)


def resampled(setting: Setting, size: float) -> Fields:
    """Take rows in steps of the root of size, and read the samples off straight lines between them."""
    # The root, as straight lines miss a curve by the square of the step.
    step, times = float(np.sqrt(size)), setting.times
    place = (times - times[0]) / step
    before = np.floor(place)
    share = (place - before)[:, None]
    grid, rows = np.unique(times[0] + step * np.stack([before, before + 1]), return_inverse=True)
    u, v = setting.at(grid).run()
    left, right = rows.reshape(2, -1)

    def straight(field: ndarray) -> ndarray:
        return np.asarray((1 - share) * field[left] + share * field[right])

    return straight(u), None if v is None else straight(v)


def _kept(field: ndarray, size: float) -> ndarray:
    shown = field.ravel().copy()
    for k in range(1, len(shown)):
        shown[k] = (1 - size) * shown[k] + size * shown[k - 1]
    return shown.reshape(field.shape)


def _lowered(field: ndarray, size: float) -> ndarray:
    return np.asarray(field - size * np.mean(field, axis=1, keepdims=True))


def _with_scale(fields: Fields, factor: ndarray) -> Fields:
    u, v = fields
    return u * factor, None if v is None else v * factor
