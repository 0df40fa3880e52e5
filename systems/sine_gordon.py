"""The discrete sine-Gordon lattice (Frenkel-Kontorova), a chain of coupled pendula.

    u_n'' = C (u_{n+1} + u_{n-1} - 2 u_n) - sin(u_n),   n = 1..N

Real field of angles in radians, second order, dimensionless. Site n is entry n - 1 of an array. The ends are free:
u_0 = u_1 and u_{N+1} = u_N. C = 1/h^2 with the lattice spacing h; initial states are functions of x_n, N points evenly
spaced on [-N h/2, N h/2], both ends included.

The equation does not change under u -> -u, u -> u + 2 pi, n -> -n and t -> -t. On free, fixed, periodic and
antiperiodic chains it conserves the energy

    E = sum_n [ v_n^2 / 2 + 1 - cos(u_n) ] + (C/2) sum over bonds (u_{n+1} - u_n)^2

Source: the paper (see `latticebench.systems`), equation (3) and Table 1; libraries (25)-(27).
"""

from latticebench.systems.lattice import Initial, System, library

SYSTEM = System(
    name="sine-gordon",
    title="discrete sine-Gordon",
    equation="C*(u[n+1]+u[n-1]-2*u[n]) - sin(u[n])",
    order=2,
    is_complex=False,
    # The paper does not state the speed v of the kink.
    parameters={"C": 0.5, "v": 0.5},
    initials={
        "kink": Initial(
            u="4*atan(exp(x/sqrt(1-v**2)))",
            v="-2*v/sqrt(1-v**2)/cosh(x/sqrt(1-v**2))",
        ),
        "phi4-kink": Initial(
            u="tanh(x/sqrt(1-v**2))",
            v="-v/sqrt(1-v**2)/cosh(x/sqrt(1-v**2))**2",
        ),
    },
    libraries=(
        library(
            "sines",
            "u[n+1]; u[n-1]; u[n]; sin(u[n]); sin(2*u[n]); sin(3*u[n]); sin(4*u[n]); sin(5*u[n])",
            "paper, first library of the discrete sine-Gordon lattice",
        ),
        library(
            "powers",
            "u[n+1]; u[n-1]; u[n]; u[n]**3; u[n]**5",
            "paper, second library of the discrete sine-Gordon lattice",
        ),
        library(
            "mixed",
            "u[n+1]; u[n-1]; u[n]; u[n]**3; u[n]**2; u[n]**5; sin(u[n]); sin(2*u[n])",
            "paper, third library of the discrete sine-Gordon lattice",
        ),
        library("lib2", "u[n+1]; u[n-1]; u[n]; sin(u[n])", "the four-term library of this lattice"),
        library("equation", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])", "the equation's own terms"),
    ),
    source="the paper, equation (3), Table 1",
    conserved="v[n]**2/2 + 1 - cos(u[n]) - C/2*u[n]*(u[n+1]+u[n-1]-2*u[n])",
    half_length="N/(2*sqrt(C))",
    integrator="rk4",
    notes="The paper uses both its own kink and the phi^4 kink as initial states, and does not give their speed v.",
)
