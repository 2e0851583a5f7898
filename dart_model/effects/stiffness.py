"""Linear stiffness beside the strut's own."""

from dart_model.effects.law import Effect, Floats, Parameter


def _force(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    return -p[0] * (height_m - strut[0])


LINEAR_STIFFNESS = Effect(
    name="linear_stiffness",
    family="stiffness",
    words="linear stiffness",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", -1e12, 1e12, "stiffness about the free length"),
    ),
    force=_force,
    excitation="heights on both sides of the rest position, at more than one frequency",
    reference="Rao, Mechanical Vibrations (2017), 1.7",
    linear=True,
    shown=("stiffness_n_per_m",),
)
