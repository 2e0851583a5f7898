"""A further mass that hangs on the upper body by a spring."""

import math

from dart_model.effects.law import Effect, Motion, Parameter, Rates, Start, State
from dart_model.effects.ranges import geometric, grid, moving, within


def _hidden_mass(
    velocity_m_per_s: float,
    deflection_m: float,
    mass_velocity_m_per_s: float,
    gravity_m_per_s2: float,
    mass_kg: float,
    frequency_hz: float,
    damping_ratio: float,
) -> float:
    # The deflection is that from the static equilibrium, where the spring carries the mass: the
    # weight of the mass acts on the body.
    omega = 2.0 * math.pi * frequency_hz
    stretching = mass_velocity_m_per_s - velocity_m_per_s
    spring_and_damper = omega * (omega * deflection_m + 2.0 * damping_ratio * stretching)
    return mass_kg * (spring_and_damper - gravity_m_per_s2)


def _hidden_mass_rate(
    velocity_m_per_s: float,
    deflection_m: float,
    mass_velocity_m_per_s: float,
    frequency_hz: float,
    damping_ratio: float,
) -> Rates:
    omega = 2.0 * math.pi * frequency_hz
    stretching = mass_velocity_m_per_s - velocity_m_per_s
    return stretching, -omega * (omega * deflection_m + 2.0 * damping_ratio * stretching)


@moving
def _hidden_mass_starts(motion: Motion) -> list[Start]:
    low_hz, high_hz = 3.0 / motion.duration_s, 0.1 / motion.step_s
    if motion.stiffness_n_per_m > 0.0:
        # Far from the strut's own resonance a further one is an added mass, or is not excited.
        natural_hz = math.sqrt(motion.stiffness_n_per_m / motion.mass_kg) / (2.0 * math.pi)
        low_hz, high_hz = max(low_hz, 0.2 * natural_hz), min(high_hz, 15.0 * natural_hz)
    mass_kg = 0.1 * motion.mass_kg
    frequencies = geometric(low_hz, high_hz, 16)
    return grid([mass_kg], frequencies, [0.01, 0.06])


_LEAST_DAMPING_RATIO = 0.012 / (2.0 * math.pi)
"""By the least logarithmic decrement of EN 1991-1-4:2005, table F.2 (welded steel), 0.012; with
less, a free vibration lasts as long as a run and passes for a tone of whatever cause."""

HIDDEN_MASS = Effect(
    name="hidden_mass",
    family="unmodelled_mode",
    words="a further mass on a spring (an unmodelled mode)",
    parameters=(
        Parameter("mass_kg", "kg", 1e-12, 1e9, "mass on the spring"),
        Parameter("frequency_hz", "Hz", 1e-9, 1e9, "natural frequency of the mass on its spring"),
        Parameter("damping_ratio", "", 0.0, 2.0, "ratio of the damping to the critical damping"),
    ),
    force=_hidden_mass,
    excitation="frequencies around the natural frequency of the mass on its spring",
    reference="Den Hartog, Mechanical Vibrations (1956), 3.2, dynamic absorber",
    rate=_hidden_mass_rate,
    states=(State("deflection_m", 0.01), State("mass_velocity_m_per_s", 0.01)),
    fits_state=True,
    starts=_hidden_mass_starts,
    bounds=within(
        mass_kg=lambda m: (1e-4 * m.mass_kg, 3.0 * m.mass_kg),
        frequency_hz=lambda m: (1.0 / m.duration_s, 0.25 / m.step_s),
        damping_ratio=lambda _: (_LEAST_DAMPING_RATIO, 2.0),
    ),
    simpler=("added_mass",),
    benches=("force_given",),
    shown=("mass_kg", "frequency_hz"),
)
