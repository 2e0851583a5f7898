"""Linear damping in parallel with the strut's."""

from dart_model.effects.law import Effect, Parameter


def _viscous(velocity_m_per_s: float, damping_n_s_per_m: float) -> float:
    return -damping_n_s_per_m * velocity_m_per_s


LINEAR_DAMPING = Effect(
    name="linear_damping",
    family="damping",
    words="linear damping",
    parameters=(Parameter("damping_n_s_per_m", "N·s/m", -1e12, 1e12, "viscous damping"),),
    force=_viscous,
    excitation="velocities at more than one frequency",
    reference="Rao, Mechanical Vibrations (2017), 1.9",
    linear=True,
    shown=("damping_n_s_per_m",),
)
