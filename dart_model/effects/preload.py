"""Preload: a constant force, such as gas preload, unaccounted weight or a load cell's offset."""

from dart_model.effects.law import Effect, Floats, Parameter


def _force(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return p[0]


PRELOAD = Effect(
    name="preload",
    family="preload",
    words="a constant preload",
    parameters=(
        Parameter("force_n", "N", -1e12, 1e12, "constant force that pushes the bodies apart"),
    ),
    force=_force,
    excitation="any run whose mean height is measured",
    reference="Dixon, The Shock Absorber Handbook (2007), gas preload",
    linear=True,
    shown=("force_n",),
)
