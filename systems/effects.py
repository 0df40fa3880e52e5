"""The catalogue: pieces of physics and of measurement that a declared equation may lack.

Each effect has a formula in the term language, a way of acting (a term at every site, at one site, in time; other
ends; a sensor that distorts the field), a hint what to look for, and a source. The size of its coefficients is not
part of it: that comes from data.
Users add effects of their own in a TOML file (see `user_files.load_effects`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.parser import TermError, parse

HOW: dict[str, str] = {
    "everywhere": "the formula, at every site and time",
    "harmonic": "the formula times cos(omega s) and sin(omega s), s counted from the middle, at every site alike; "
    "omega found, and begin and end where it does not last",
    "harmonic at one site": "the same at one site only; omega and site found, and begin and end where it does not last",
    "pulse": "the formula times exp(-((t - at) / width)^2 / 2), at every site alike; at and width found",
    "pulse at one site": "the same at one site only; at, width and site found",
    "ramp": "a declared term, or the formula, times s / T, s counted from the middle, T being the length of "
    "the longest recording; term found",
    "step": "a declared term, or the formula, from one time on; term and time found",
    "delayed": "the formula of the field a delay earlier; delay found",
    "side mass": "a mass that is not read, on a spring and a dashpot at one site; site, frequency and damping found",
    "support": "a support that sways, is not read, and carries all sites, which are read as it sees them; mass, "
    "frequency and damping found",
    "long range": "sum over r >= 2 of (u_{n+r} + u_{n-r} - 2 u_n) / r^s; s found",
    "alternating": "the formula with the sign (-1)^k at site k",
    "one site": "the formula at one site only; site found",
    "one bond": "the formula at one site, and its mirror image, n+1 and n-1 exchanged, at the next; site found",
    "every site": "the formula at every site with a coefficient of its own",
    "every bond": "the formula at one site of each bond, and its mirror image, n+1 and n-1 exchanged, at the "
    "other, with a coefficient for each bond",
    "one equation": "the whole right-hand side of one site is scaled; site found",
    "ends": "the chain ends in another way than declared",
    "offset": "the reading is u + b; at one site, which is found, or with a b for every site, in "
    "all recordings or in one",
    "drift": "the reading is u + d (t - t_0) / T, T being the recording's length; at one site, which is found",
    "jump": "the reading is u + b from one time on; at one site; time and site found",
    "wander": "the reading is u + w(t), w wandering at random, more slowly than the sites swing; at one site, found",
    "hum": "the reading is u + a cos(omega s) + b sin(omega s), s counted from the middle; at one site or at all "
    "alike; omega and site found",
    "gain": "the reading is g u; at one site, which is found, with a g for every site, or "
    "with one for all in a recording",
    "curve": "the reading is u + c T(u), T being a power, with one c for all sensors or at one of them",
    "cyclic": "the reading is u + a sin(k u) + b (cos(k u) - 1), at one sensor or with the same for all; k found",
    "gain drift": "the reading is (1 + c (t - t_0) / T) u, T being the recording's length; at one site, which is found",
    "gain jump": "the reading is (1 + c) u from one time on; at one site; time and site found",
    "crosstalk": "the reading is u + c times u of the sensors next to it, of the one on one side, or the mean of all",
    "imbalance": "the reading of a complex field is z + c conj(z), with one c for all sites",
    "lag": "the reading is u a time tau ago; at one site, which is found, with a tau for every site, with one more tau "
    "at each, or, beside a measured input, with one tau for all",
    "sensor clock": "the reading is u at a time that is late by c (t - t_0); at one site, or from one on",
    "clock": "the recorded times are wrong by a share of themselves",
    "clock jump": "from one time on readings are of a later time than they say; time found",
}
"""The ways of acting, each with what it does; `latticebench.diagnosis.acting` has one class for each."""


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Attributes:
        name: what it is called.
        formula: in the term language; used wherever neither of the next two applies.
        first_order: the formula on a first-order lattice; None if it is the same, "" if it has no meaning there.
        complex_field: the formula on a complex field; None if it is the same, "" if it has no meaning there.
        acts: the way of acting, see `HOW`.
        real: whether the coefficient is real even on a complex field; otherwise it is two real ones, of T and i*T.
        orders: of the time derivative for which the effect has a meaning.
        takes: whether it only takes energy, so that its coefficient is negative.
        look_for: what it shows in data.
        source: where to read about it.

    Raises:
        InputError: the name, the way of acting or a formula is invalid.
    """

    name: str
    formula: str
    acts: str = "everywhere"
    first_order: str | None = None
    complex_field: str | None = None
    real: bool = False
    orders: tuple[int, ...] = (1, 2)
    takes: bool = False
    look_for: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        """Check every text."""
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", self.name):
            raise InputError(
                f"effect {self.name!r}: a name is small letters, digits and single dashes, such as dry-friction"
            )
        if self.acts not in HOW:
            raise unknown("way of acting", str(self.acts), HOW, f"effect {self.name!r}")
        if not (self.formula or self.first_order or self.complex_field):
            raise InputError(f"effect {self.name!r}: it has no formula")
        for text in (self.formula, self.first_order, self.complex_field):
            if text:
                try:
                    parse(text)
                except TermError as error:
                    raise InputError(f"effect {self.name!r}: {error}") from None

    @property
    def how(self) -> str:
        """What its way of acting does, in words."""
        return HOW[self.acts]

    @property
    def is_a_term(self) -> bool:
        """Whether it is its formula at every site and time, so that an equation may declare it."""
        return self.acts == "everywhere"

    def texts(self, order: int, is_complex: bool) -> tuple[str, ...]:
        """Return the terms on a lattice: T, or T and i*T for a complex coefficient; none if it has no meaning there."""
        if order not in self.orders:
            return ()
        text = self.formula
        if is_complex and self.complex_field is not None:
            text = self.complex_field
        elif order == 1 and self.first_order is not None:
            text = self.first_order
        if not text:
            return ()
        return (
            (text, f"i*({text})" if "+" in text or "-" in text else f"i*{text}")
            if is_complex and not self.real
            else (text,)
        )


def find(name: str, catalogue: tuple[Effect, ...] | None = None) -> Effect:
    """Return the effect of this name, from the built-in catalogue if none is given.

    Raises:
        InputError: there is none of this name.
    """
    for effect in catalogue or CATALOGUE:
        if effect.name == name:
            return effect
    raise unknown("effect", name, [effect.name for effect in catalogue or CATALOGUE])


NAYFEH = "Nayfeh & Mook, Nonlinear Oscillations (1979)"
BRAUN = "Braun & Kivshar, The Frenkel-Kontorova Model (2004)"
KEVREKIDIS = "Kevrekidis, The Discrete Nonlinear Schroedinger Equation (2009)"
ARANSON = "Aranson & Kramer, Rev. Mod. Phys. 74, 99 (2002)"
SHAW = "Shaw & Holmes, J. Sound Vib. 90, 129 (1983)"
LJUNG = "Ljung, System Identification (1999)"

CATALOGUE: tuple[Effect, ...] = (
    # Motion.
    Effect(
        "damping", "v[n]", first_order="u[n]", real=True,
        look_for="amplitudes that fall exponentially, alike at all sizes", source=NAYFEH,
    ),
    Effect(
        "quadratic-drag", "abs(v[n])*v[n]", orders=(2,), takes=True,
        look_for="large swings fall faster than small ones, as one over time", source=NAYFEH,
    ),
    Effect(
        "dry-friction", "sign(v[n])", orders=(2,), takes=True,
        look_for="amplitudes that fall along a straight line, to a stop", source=NAYFEH,
    ),
    Effect(
        "nonlinear-damping", "u[n]**2*v[n]", complex_field="abs(u[n])**2*v[n]", orders=(2,), real=True,
        look_for="friction that grows with the displacement; a swing of its own where friction at rest is negative",
        source="van der Pol, Phil. Mag. 2, 978 (1926)",
    ),
    Effect(
        "onsite-linear", "u[n]",
        look_for="one frequency shift for all sizes and wavelengths", source=BRAUN,
    ),
    Effect(
        "onsite-quadratic", "u[n]**2", complex_field="abs(u[n])*u[n]",
        look_for="swings that reach farther to one side", source=NAYFEH,
    ),
    Effect(
        "onsite-cubic", "u[n]**3", complex_field="abs(u[n])**2*u[n]",
        look_for="a frequency that moves with the square of the size", source=NAYFEH,
    ),
    Effect(
        "onsite-quintic", "u[n]**5", complex_field="abs(u[n])**4*u[n]",
        look_for="a frequency that moves with the fourth power of the size", source=KEVREKIDIS,
    ),
    Effect(
        "onsite-bilinear", "abs(u[n])", complex_field="", orders=(2,),
        look_for="swings that take longer to one side, alike at all sizes, as of a crack or of a contact", source=SHAW,
    ),
    Effect("constant-force", "1", look_for="a rest state moved the same way everywhere", source=BRAUN),
    Effect(
        "drive", "1", acts="harmonic",
        look_for="one line in the spectrum of the residual, in step at all sites", source=NAYFEH,
    ),
    Effect(
        "parametric-drive", "u[n]", acts="harmonic",
        look_for="lines at the sum and difference of a frequency and the motion's own", source=NAYFEH,
    ),
    Effect("known-input", "f[n]", look_for="a residual that follows the measured input", source=LJUNG),
    Effect(
        "gradient", "n", first_order="n*u[n]", complex_field="n*u[n]",
        look_for="sites pushed, or turning in phase, in proportion to their place", source=KEVREKIDIS,
    ),
    Effect(
        "trap", "n**2*u[n]",
        look_for="the ends stiffer, or turning faster in phase, than the middle", source=KEVREKIDIS,
    ),
    Effect("memory", "u[n]", acts="delayed", look_for="a residual that follows the field with a lag", source=LJUNG),
    Effect("kick", "1", acts="pulse", look_for="a residual that begins at one time, at all sites", source=NAYFEH),
    Effect(
        "coefficient-drift", "u[n]", acts="ramp",
        look_for="a frequency or a loss that changes steadily, as of what warms up, whatever the size of the swings",
        source=NAYFEH,
    ),
    Effect(
        "coefficient-jump", "u[n]", acts="step", look_for="an equation that is another one from one time on",
        source="Basseville & Nikiforov, Detection of Abrupt Changes (1993)",
    ),
    # Coupling.
    Effect(
        "next-neighbour", "u[n+2]+u[n-2]-2*u[n]",
        look_for="short waves off by more than long ones, alike at all sizes", source=BRAUN,
    ),
    Effect(
        "quadratic-coupling", "(u[n+1]-u[n])**2-(u[n-1]-u[n])**2", complex_field="",
        look_for="springs that are stiffer stretched than pressed, or the other way round",
        source="Fermi, Pasta & Ulam, Studies of Nonlinear Problems, Los Alamos LA-1940 (1955)",
    ),
    Effect(
        "bilinear-coupling", "abs(u[n+1]-u[n])-abs(u[n]-u[n-1])", complex_field="", orders=(2,),
        look_for="springs that are softer when stretched than when pressed, or the other way round, at all sizes",
        source=SHAW,
    ),
    Effect(
        "bond-damping", "v[n+1]+v[n-1]-2*v[n]", orders=(2,), real=True,
        look_for="short waves that fade faster than long ones; a motion all alike does not",
        source="Landau & Lifshitz, Theory of Elasticity (1970), viscosity of solids",
    ),
    Effect(
        "nonlinear-coupling", "(u[n+1]-u[n])**3+(u[n-1]-u[n])**3",
        complex_field="abs(u[n+1]-u[n])**2*(u[n+1]-u[n])+abs(u[n-1]-u[n])**2*(u[n-1]-u[n])",
        look_for="a residual where neighbours differ most", source="Flach & Gorbach, Phys. Rep. 467, 1 (2008)",
    ),
    Effect(
        "asymmetric-coupling", "(u[n+1]-u[n-1])/2",
        look_for="waves to the right and to the left that differ",
        source="Hatano & Nelson, Phys. Rev. Lett. 77, 570 (1996)",
    ),
    Effect(
        "intersite-nonlinearity", "", complex_field="abs(u[n])**2*(u[n+1]+u[n-1])",
        look_for="coupling that grows with the size", source=KEVREKIDIS,
    ),
    Effect(
        "long-range", "u[n]", acts="long range",
        look_for="far sites that answer at once", source="Gaididei et al., Phys. Rev. E 55, 6141 (1997)",
    ),
    # Complex fields.
    Effect(
        "nonlinear-loss", "", complex_field="abs(u[n])**2*u[n]", real=True,
        look_for="a norm that falls fastest where it is large", source=ARANSON,
    ),
    Effect(
        "gain-loss", "", complex_field="u[n]", acts="alternating", real=True,
        look_for="neighbours of which one grows and one fades",
        source="Konotop et al., Rev. Mod. Phys. 88, 035002 (2016)",
    ),
    # Places.
    Effect("defect", "u[n]", acts="one site", look_for="a residual at one site and its neighbours", source=BRAUN),
    Effect(
        "bond-defect", "u[n+1]-u[n]", acts="one bond",
        look_for="a residual of opposite sign at two neighbours", source=BRAUN,
    ),
    Effect(
        "unequal-bonds", "u[n+1]-u[n]", acts="every bond",
        look_for="a residual of each bond's own, of opposite sign at its two ends",
        source="Dyson, Phys. Rev. 92, 1331 (1953)",
    ),
    Effect(
        "local-damping", "v[n]", acts="one site", orders=(2,),
        look_for="amplitudes that fall fastest where one site moves most", source=NAYFEH,
    ),
    Effect(
        "local-friction", "sign(v[n])", complex_field="", acts="one site", orders=(2,), takes=True,
        look_for="one site that turns with a jerk and stops first, as on a bearing that grates", source=NAYFEH,
    ),
    Effect(
        "local-cubic", "u[n]**3", complex_field="abs(u[n])**2*u[n]", acts="one site",
        look_for="a residual at one site that grows with the cube of its swings, as beside a magnet or of an impurity",
        source="Molina & Tsironis, Phys. Rev. B 47, 15330 (1993)",
    ),
    Effect(
        "local-bilinear", "abs(u[n])", complex_field="", acts="one site", orders=(2,),
        look_for="swings of one site that take longer to one side, alike at all sizes", source=SHAW,
    ),
    Effect(
        "local-drive", "1", acts="harmonic at one site",
        look_for="one line in the spectrum of the residual, at one site and what it moves", source=NAYFEH,
    ),
    Effect(
        "local-kick", "1", acts="pulse at one site",
        look_for="a residual that begins at one time and site, and spreads", source=NAYFEH,
    ),
    Effect(
        "side-mass", "u[n]", complex_field="", acts="side mass", orders=(2,),
        look_for="a line of one site's own, with another phase above it than below", source="Den Hartog, Mechanical "
        "Vibrations (1956), section 3.2",
    ),
    Effect(
        "swaying-support", "u[n]", complex_field="", acts="support", orders=(2,),
        look_for="a residual that is the same at all sites, and follows what they do together",
        source="Bennett et al., Proc. R. Soc. A 458, 563 (2002)",
    ),
    Effect(
        "unequal-masses", "u[n]", acts="one equation",
        look_for="one site that answers all forces too much or too little", source=BRAUN,
    ),
    Effect(
        "ends", "u[n]", acts="ends",
        look_for="a residual that starts at the ends and travels inward", source="this project",
    ),
    Effect(
        "disorder", "u[n]", acts="every site",
        look_for="a residual of each site's own", source="Anderson, Phys. Rev. 109, 1492 (1958)",
    ),
    Effect(
        "own-rates", "1", complex_field="", acts="every site", orders=(1,),
        look_for="sites that drift each at a pace of its own, as oscillators of unlike frequencies do",
        source="Kuramoto, Chemical Oscillations, Waves, and Turbulence (1984), section 5.4",
    ),
    # The instrument.
    Effect("sensor-offset", "1", acts="offset", look_for="a residual that does not change in time", source=LJUNG),
    Effect("sensor-drift", "1", acts="drift", look_for="one sensor's residual that changes slowly", source=LJUNG),
    Effect(
        "sensor-jump", "1", acts="jump", look_for="one sensor's residual that moves at one time, and stays",
        source=LJUNG,
    ),
    Effect(
        "sensor-wander", "1", acts="wander", look_for="one sensor's residual that goes its own slow way",
        source="Durbin & Koopman, Time Series Analysis by State Space Methods (2012), section 2.2",
    ),
    Effect(
        "sensor-hum", "1", acts="hum", look_for="lines in the spectrum of one sensor that its neighbours do not follow",
        source="Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), example 4.2",
    ),
    Effect("sensor-gain", "u[n]", acts="gain", look_for="a residual in proportion to one site's reading", source=LJUNG),
    Effect(
        "sensor-cyclic", "sin(u[n])", complex_field="", acts="cyclic",
        look_for="an error that repeats with the reading, once in a turn of an encoder or a fringe",
        source="Heydemann, Appl. Opt. 20, 3382 (1981)",
    ),
    Effect(
        "sensor-gain-drift", "t*u[n]", acts="gain drift",
        look_for="a residual in proportion to one site's reading, more and more so",
        source=LJUNG,
    ),
    Effect(
        "sensor-gain-jump", "u[n]", acts="gain jump",
        look_for="a residual in proportion to one site's reading, from one time on", source=LJUNG,
    ),
    Effect(
        "sensor-imbalance", "", complex_field="conj(u[n])", acts="imbalance",
        look_for="a residual that turns against the field, as of receivers whose two quadratures differ",
        source="Razavi, RF Microelectronics (2011), section 4.2",
    ),
    Effect(
        "sensor-crosstalk", "u[n+1]+u[n-1]", complex_field="u[n+1]+u[n-1]", acts="crosstalk", real=True,
        look_for="a residual in proportion to the readings beside", source="Ott, Electromagnetic Compatibility "
        "Engineering (2009), chapter 2",
    ),
    Effect(
        "sensor-curve", "u[n]**2", complex_field="abs(u[n])*u[n]", acts="curve",
        look_for="a residual in proportion to the square of the reading", source=LJUNG,
    ),
    Effect(
        "sensor-saturation", "u[n]**3", complex_field="abs(u[n])**2*u[n]", acts="curve",
        look_for="large swings that read too small, or too large, to both sides, as through a lens",
        source="Brown, Photogramm. Eng. 32, 444 (1966)",
    ),
    Effect(
        "sensor-lag", "v[n]", acts="lag", orders=(2,),
        look_for="a residual in proportion to the velocity at one site, as of a filter or of channels that are scanned",
        source=LJUNG,
    ),
    Effect(
        "sensor-clock", "t*v[n]", acts="sensor clock", orders=(2,),
        look_for="one sensor that falls behind, or runs ahead, as where each logger has a clock of its own",
        source=LJUNG,
    ),
    Effect(
        "clock", "v[n]", acts="clock",
        look_for="a residual in proportion to the velocity, at all sites at once", source=LJUNG,
    ),
    Effect(
        "clock-jump", "v[n]", acts="clock jump", orders=(2,),
        look_for="a motion that is ahead of itself from one time on, as where a camera drops frames", source=LJUNG,
    ),
)  # fmt: skip
