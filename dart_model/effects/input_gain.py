"""Input gain: the force that acts is not the force that was recorded."""

from dart_model.effects.law import Effect, Floats, Parameter


def _force(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return p[0] * applied_force_n


INPUT_GAIN = Effect(
    name="input_gain",
    family="input_gain",
    words="the right gain of the applied force",
    parameters=(Parameter("gain", "", -0.99, 10.0, "share of the applied force that is missing"),),
    force=_force,
    excitation="an applied force of several frequencies or levels",
    reference="Ljung, System Identification (1999), 14.1",
    linear=True,
    benches=("force_given",),
    shown=("gain",),
)
