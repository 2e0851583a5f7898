"""A further mass that hangs on the upper body by a spring."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter, Writable


def _hidden_mass(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    # The state is the spring's deflection in m and the hidden mass's own velocity in m/s.
    omega = 2.0 * math.pi * p[1]
    return p[0] * omega * (omega * state[0] + 2.0 * p[2] * (state[1] - velocity_m_per_s)) - p[3]


def _hidden_mass_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    omega = 2.0 * math.pi * p[1]
    out[0] = state[1] - velocity_m_per_s
    out[1] = -omega * (omega * state[0] + 2.0 * p[2] * (state[1] - velocity_m_per_s))


HIDDEN_MASS = Effect(
    name="hidden_mass",
    family="unmodelled_mode",
    parameters=(
        Parameter("mass_kg", "kg", 1e-3, 1e4, "mass on the spring"),
        Parameter("frequency_hz", "Hz", 0.05, 60.0, "natural frequency of the mass on its spring"),
        Parameter("damping_ratio", "", 0.0, 2.0, "damping over critical damping"),
        Parameter("weight_n", "N", -1e5, 1e5, "weight the mass adds at rest"),
    ),
    force=_hidden_mass,
    excitation="frequencies around the mass's own resonance",
    reference="Den Hartog, Mechanical Vibrations (1956), 3.2, dynamic absorber",
    rate=_hidden_mass_rate,
    state_size=2,
    scaled=(0, 3),
)
