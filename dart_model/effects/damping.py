"""Linear damping beside the strut's own."""

from dart_model.effects.law import Effect, Floats, Parameter


def _force(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * velocity_m_per_s


LINEAR_DAMPING = Effect(
    name="linear_damping",
    family="damping",
    words="linear damping",
    parameters=(Parameter("damping_n_s_per_m", "N·s/m", -1e12, 1e12, "viscous damping"),),
    force=_force,
    excitation="velocities at more than one frequency",
    reference="Rao, Mechanical Vibrations (2017), 1.9",
    linear=True,
    shown=("damping_n_s_per_m",),
)
