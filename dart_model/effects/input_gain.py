"""Input gain: the force that acts is not the force that was recorded."""

from dart_model.effects.law import Effect, Parameter


def _gain_force(applied_force_n: float, gain: float) -> float:
    return gain * applied_force_n


INPUT_GAIN = Effect(
    name="input_gain",
    family="input_gain",
    words="a correction of the gain of the applied force",
    parameters=(
        Parameter(
            "gain",
            "",
            -0.99,
            10.0,
            "relative correction: the force that acts is (1 + gain) times the recorded one",
        ),
    ),
    force=_gain_force,
    excitation="an applied force of several frequencies or levels",
    reference="Ljung, System Identification (1999), 14.1",
    linear=True,
    benches=("force_given",),
    shown=("gain",),
)
