"""The diagnosis names what is missing and nothing else, whatever the units, the order of sites and the clock."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from latticebench.bench.report.notes import notes
from latticebench.bench.trials.laboratory import make_recording
from latticebench.bench.trials.laboratory.instruments import Kind
from latticebench.bench.trials.laboratory.judging import findings, judge, written
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis.cure import corrected
from latticebench.diagnosis.repair import Interrupted, diagnose
from latticebench.systems import find
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, simulate


@dataclass(frozen=True)
class Lab:
    """A recording of a simulated laboratory of some 500 readings per sensor: what is asked of the simulator."""

    seed: int
    sites: int
    effects: tuple[str, ...]
    instrument: Kind

    def __str__(self) -> str:
        return f"{self.sites} sites-{'+'.join(self.effects) or 'nothing'}-{self.instrument}-{self.seed}"


NONE, SPIKES, DENSE = Lab(102, 2, (), "white"), Lab(102, 3, (), "spikes"), Lab(103, 2, (), "white")
OFFSET = Lab(102, 2, ("sensor-offset",), "white")
STIFFENING = Lab(103, 1, ("onsite-cubic", "damping"), "heavy-tailed")
DRAG = Lab(103, 1, ("quadratic-drag",), "white")
DEFECT = Lab(102, 3, ("defect",), "unequal")
COUPLING = Lab(101, 3, ("nonlinear-coupling",), "gaps")
GAIN = Lab(102, 2, ("damping", "sensor-gain"), "white")
COLOURED = Lab(102, 3, ("damping", "sensor-offset"), "coloured")


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@functools.cache
def made(lab):
    return make_recording(lab.seed, instrument=lab.instrument, effects=lab.effects, sites=lab.sites)


def diagnosed_as(recording, samples):
    return diagnose(recording.declared, recording.order, [samples], CATALOGUE)


@functools.cache
def diagnosed(lab):
    return diagnosed_as(made(lab), made(lab).samples)


# What is named --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lab", [OFFSET, STIFFENING, *map(slow, (DRAG, DEFECT, COUPLING, GAIN, COLOURED))], ids=str)
def test_what_a_laboratory_recording_lacks_is_named_and_nothing_else(lab):
    recording, found = made(lab), diagnosed(lab)
    assert found.verdict == "explained"
    judged = judge(written(recording), findings(found))
    assert (judged.missed, judged.invented) == ((), ())
    assert len(found.findings) == len(lab.effects)
    assert found.residual[1] < found.residual[0]
    assert found.forecast[1] <= found.forecast[0]
    assert found.criterion[1] < 0
    assert all(one.evidence > 5 for one in found.findings)
    assert found.horizons[-1].samples == len(found.data[0].t)
    assert found.against(recording.coefficients).coefficients[1] < 0.05


def test_a_zero_that_drifts_is_named_with_its_sensor_and_how_far_it_goes():
    recording = made(NONE)
    read, far = recording.samples, 6 * recording.noise[1]
    off = np.outer((read.t - read.t[0]) / (read.t[-1] - read.t[0]), [0.0, far])
    found = diagnosed_as(recording, replace(read, u=read.u + off))
    (one,) = found.findings
    assert (one.name, one.site, found.verdict) == ("sensor-drift", 1, "explained")
    ((size, error),) = one.values.values()
    assert abs(size - far) < 4 * error < far
    assert found.residual[1] == pytest.approx(1, abs=0.1)


def test_a_zero_that_wanders_is_named_with_its_sensor_and_how_far_it_goes_and_leaves_the_noise():
    recording = made(NONE)
    read, far = recording.samples, 6 * recording.noise[1]
    steps = np.diff(read.t, prepend=read.t[0]) / (read.t[-1] - read.t[0])
    walk = far * np.cumsum(np.random.default_rng(5).normal(size=len(steps)) * np.sqrt(steps))
    found = diagnosed_as(recording, replace(read, u=read.u + np.outer(walk, [0.0, 1.0])))
    (one,) = found.findings
    assert (one.name, one.site, found.verdict) == ("sensor-wander", 1, "explained")
    assert 0.7 * far < one.placed.walk < 1.4 * far
    np.testing.assert_allclose(found.noise, recording.noise, rtol=0.2)
    assert "a zero that wanders by" in found.noise_lines[1]
    assert "a zero that wanders by" not in found.noise_lines[0]
    # It is seen as a part of the readings that the model follows.
    (curve,) = found.after.curves()
    assert np.nanstd(curve.level[:, 0, 0, 1] - curve.field[:, 0, 0, 1] - walk) < recording.noise[1]
    assert found.forecast[1] <= found.forecast[0]


def humming(sensors, lab=NONE, fast=0.7, times=6):
    """A recording of two sites with a hum of so many times the noise, what is found in it, and size and frequency."""
    recording = made(lab)
    read, size, omega = recording.samples, times * recording.noise[1], fast * recording.chain.fast
    here = np.isin(np.arange(read.sites), sensors)
    found = diagnosed_as(recording, replace(read, u=read.u + np.outer(size * np.cos(omega * read.t), here)))
    return recording, found, size, omega


@pytest.mark.parametrize("hum", [(NONE, 0.7, 6), pytest.param((DENSE, 13.3, 1.5), id="too fast for a force")])
def test_a_hum_of_one_sensor_is_named_with_its_size_and_its_frequency_and_can_be_taken_away(hum):
    recording, found, size, omega = humming([1], *hum)
    (one,) = found.findings
    assert (one.name, one.site, found.verdict) == ("sensor-hum", 1, "explained")
    value, error = one.values["omega"]
    assert abs(value - omega) < 4 * error < 0.1 * omega
    assert np.linalg.norm(one.placed.strength) == pytest.approx(size, rel=0.15)
    assert found.residual[1] == pytest.approx(1, abs=0.1)
    left = corrected(found.after.model, found.data[0], 0).u - recording.samples.u
    assert np.sqrt(np.mean(left**2)) < 0.1 * size


def test_a_hum_of_all_sensors_alike_cannot_be_told_from_a_force_on_all_sites_of_a_linear_chain():
    _, found, _, omega = humming([0, 1])
    (one,) = found.findings
    assert {"sensor-hum", "drive"} <= {one.name, *one.alternatives}
    assert one.site is None
    assert one.values["omega"][0] == pytest.approx(omega, rel=0.02)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_ends_that_are_declared_wrongly_are_named_alone_where_a_kink_stands_between_them(noise):
    system = find("sine-gordon")
    clean = simulate(system, sites=21, times=np.arange(50) * 0.2)
    read = observe(clean, np.random.default_rng(1), noise=noise).observed()
    declared = library("declared", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
    found = diagnose(declared, 2, [replace(read, ends="fixed")], CATALOGUE)
    (one,) = found.findings
    assert (one.name, one.placed.settings(), found.verdict) == ("ends", {"ends": "free"}, "explained")
    np.testing.assert_allclose(found.declared[1], [0.5, -1.0], rtol=1e-6 if noise == 0 else 0.1)
    assert found.forecast[1] < found.forecast[0]


@pytest.mark.parametrize(
    ("name", "sites", "count", "seed", "silent"),
    [
        ("phi4", 9, 101, 2, None), ("phi4", 9, 101, 1, 4), ("ginzburg-landau", 5, 155, 5, None),
        *(slow("phi4", 9, 101, seed, 4) for seed in (2, 3)),
        *(slow(name, 5, 155, seed, None) for name in ("dnls", "ginzburg-landau") for seed in (1, 3)),
    ],
)  # fmt: skip
def test_where_the_ends_are_unknown_and_no_velocities_were_read_nothing_is_made_up(name, sites, count, seed, silent):
    system = find(name)
    clean = simulate(system, sites=sites, times=0.2 * np.arange(count))
    read = observe(clean, np.random.default_rng(seed), noise=0.01).observed()
    u = read.u.copy()
    if silent is not None:
        u[:, silent] = np.nan
    data = [replace(read, u=u, v=None, ends="unknown")]
    found = diagnose(system.library("equation"), system.order, data, CATALOGUE)
    assert (found.verdict, found.findings, found.left) == ("nothing missing", (), ())


@pytest.mark.parametrize("lost", [np.nan, 0.3 + 0.1j, 1j * np.nan], ids=str)
def test_a_site_of_a_complex_chain_that_was_not_read_is_no_reading_of_0(lost):
    system = find("dnls")
    clean = simulate(system, sites=8, times=0.1 * np.arange(143))
    read = observe(clean, np.random.default_rng(1), noise=0.01).observed()
    u = read.u.copy()
    # A missing number becomes nan + 0i; a sensor that is stuck is left out.
    u[:, 4] = lost
    found = diagnose(system.library("equation"), 1, [replace(read, u=u, ends=system.ends)], CATALOGUE)
    assert (found.verdict, found.findings, found.left) == ("nothing missing", (), ())
    assert found.dead == ((4,) if np.isfinite(lost) else ())


@pytest.mark.parametrize("lab", [NONE, slow(SPIKES)], ids=str)
def test_where_nothing_is_missing_nothing_is_named(lab):
    found = diagnosed(lab)
    assert found.verdict == "nothing missing"
    assert found.findings == ()
    assert found.left == ()
    assert found.after is found.before


def test_the_noise_of_every_sensor_is_said_in_the_unit_of_the_readings():
    found = diagnosed(NONE)
    np.testing.assert_allclose(found.noise, made(NONE).noise, rtol=0.15)
    assert len(found.noise_lines) >= 1
    assert found.rms[1] == pytest.approx(np.sqrt(np.mean(found.noise**2)), rel=0.1)


@functools.cache
def on_a_complex_field(effect):
    system = find("dnls")
    conditions = Conditions(sites=9, samples=40, span=8.0, variation=True)
    specimen = make(system, effect, 30, np.random.default_rng(1), conditions)
    data = [replace(specimen.samples.observed(), ends=system.ends)]
    return specimen, diagnose(system.library("equation"), system.order, data, CATALOGUE)


@pytest.mark.parametrize("effect", ["sensor-gain", *map(slow, ("trap", "damping"))])
def test_a_complex_first_order_lattice_is_diagnosed_as_well(effect):
    specimen, found = on_a_complex_field(effect)
    assert found.verdict == "explained"
    (one,) = found.findings
    assert effect in (one.name, *one.alternatives)
    if effect == "sensor-gain":
        assert one.site == specimen.about["site"]
    assert found.residual[1] == pytest.approx(1, abs=0.15)


# What must not matter -------------------------------------------------------------------------------------------------


def in_milliseconds(samples):
    return replace(samples, t=1e3 * samples.t)


def in_degrees(samples):
    """In another unit of the readings; all equations here are linear as declared."""
    return replace(samples, u=57.3 * samples.u)


def from_the_other_end(samples):
    return replace(samples, u=samples.u[:, ::-1])


def by_another_clock(samples):
    return replace(samples, t=samples.t + 1234.5)


def every_second(samples):
    return replace(samples, t=samples.t[::2], u=samples.u[::2])


CHANGES = [in_milliseconds, in_degrees, from_the_other_end, by_another_clock, every_second]
QUICK = [(change, NONE) for change in CHANGES]
SLOW = [slow(change, lab) for lab in (STIFFENING, OFFSET, DRAG, DEFECT) for change in CHANGES]


@pytest.mark.parametrize(("change", "lab"), [*QUICK, *SLOW], ids=lambda one: getattr(one, "__name__", str(one)))
def test_verdict_names_and_sites_do_not_depend_on_what_is_no_physics(change, lab):
    before, after = diagnosed(lab), diagnosed_as(made(lab), change(made(lab).samples))
    assert after.verdict == before.verdict

    sites = [one.site for one in after.findings]
    if change is from_the_other_end:
        sites = [None if site is None else lab.sites - 1 - site for site in sites]
    names = [one.name for one in after.findings]
    assert {*zip(names, sites, strict=True)} == {(one.name, one.site) for one in before.findings}


# Interruption, and what cannot be diagnosed ---------------------------------------------------------------------------


def test_an_interrupted_diagnosis_says_what_it_knows():
    recording, said = made(STIFFENING), []

    def watcher(text):
        said.append(text)
        if sum(one.startswith("following") for one in said) == 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        diagnose(recording.declared, recording.order, [recording.samples], CATALOGUE, watcher=watcher)
    found = stop.value.diagnosis
    assert len(found.horizons) == 2
    assert found.verdict in ("nothing missing", "explained", "partly explained", "unexplained")
    assert all(np.isfinite(found.residual))
    assert len(found.findings) == len(found.after.model.effects)


def test_an_interruption_before_anything_is_known_goes_through():
    recording = made(STIFFENING)

    def watcher(text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        diagnose(recording.declared, recording.order, [recording.samples], CATALOGUE, watcher=watcher)


def swinging(count, size=1.0):
    t = 0.3 * np.arange(count)
    return Samples(t, size * np.cos(t)[:, None], source="swing.csv", ends="free")


PHI4 = "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3"


def with_one_level(site, value, ends):
    """Nine sites of phi^4, of which one reads the same all the time."""
    made = observe(simulate(find("phi4"), sites=9), np.random.default_rng(1), noise=0.01).observed()
    u = made.u.copy()
    u[:, site] = value
    return replace(made, u=u, v=None, ends=ends, source="dead.csv")


@pytest.mark.parametrize(("site", "ends"), [pytest.param(4, "free", id="inside"), slow(0, "free")])
def test_what_a_dead_sensor_reads_changes_nothing_and_the_rest_is_diagnosed(site, ends):
    dead, unread = (
        diagnose(library("phi4", PHI4), 2, [with_one_level(site, value, ends)], CATALOGUE) for value in (0.3, np.nan)
    )
    assert (dead.dead, unread.dead) == ((site,), ())
    assert (dead.verdict, dead.findings) == ("nothing missing", ())
    assert np.array_equal(dead.declared, unread.declared)
    assert np.abs(dead.declared[1] - [2, 2, -2]).max() < 0.05
    assert any("does not work" in note for note in notes(dead))


@pytest.mark.parametrize(("site", "from_", "to"), [(0, 1, 1), (1, 1, 2), (8, 9, 9)])
def test_a_site_near_an_unknown_end_must_be_read(site, from_, to):
    with pytest.raises(InputError, match=rf"dead\.csv: u{site + 1} has no .* columns from u{from_} to u{to}"):
        diagnose(library("phi4", PHI4), 2, [with_one_level(site, np.nan, "unknown")], CATALOGUE)


def test_sites_that_are_held_beside_an_unknown_end_are_what_they_read():
    t = 0.1 * np.arange(300)
    modes = np.sin(np.pi * np.outer([1, 2], np.arange(5)) / 4)
    omega = np.sqrt(4 * (2 - 2 * np.cos(np.pi * np.array([1, 2]) / 4)))
    u = (np.cos(np.outer(t, omega)) * [0.7, 0.4]) @ modes
    u[:, 1:4] += 0.01 * np.random.default_rng(4).normal(size=(len(t), 3))
    u[:, [0, 4]] = 0.0
    coupling = "u[n+1]+u[n-1]-2*u[n]"
    found = diagnose(library("springs", coupling), 2, [Samples(t, u, source="held.csv", ends="unknown")], CATALOGUE)
    assert (found.dead, found.verdict) == ((), "nothing missing")
    assert found.declared[1][0] == pytest.approx(4, rel=0.01)


@pytest.mark.parametrize("count", [4, 8])
def test_too_few_readings_are_refused(count):
    with pytest.raises(InputError, match=r"swing\.csv: .* too few"):
        diagnose(library("swing", "u[n]"), 2, [swinging(count)], CATALOGUE)


def test_a_recording_in_which_nothing_moves_is_refused():
    with pytest.raises(InputError, match=r"swing\.csv: nothing moves"):
        diagnose(library("swing", "u[n]"), 2, [swinging(200, 0.0)], CATALOGUE)
