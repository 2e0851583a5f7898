"""No effect: the trivial partner of all others."""

from dart_model.effects.law import Effect, Floats


def _force(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    _p: Floats,
    _strut: Floats,
) -> float:
    return 0.0


NONE = Effect(
    name="none",
    family="none",
    words="nothing",
    parameters=(),
    force=_force,
    excitation="none",
    reference="-",
    scaled=(),
)
