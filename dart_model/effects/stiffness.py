"""Linear stiffness in parallel with the strut's."""

from dart_model.effects.law import Effect, Parameter


def _linear(height_m: float, free_length_m: float, stiffness_n_per_m: float) -> float:
    return -stiffness_n_per_m * (height_m - free_length_m)


LINEAR_STIFFNESS = Effect(
    name="linear_stiffness",
    family="stiffness",
    words="linear stiffness",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", -1e12, 1e12, "stiffness about the free length"),
    ),
    force=_linear,
    excitation="heights on both sides of the rest position, at more than one frequency",
    reference="Rao, Mechanical Vibrations (2017), 1.7",
    linear=True,
    shown=("stiffness_n_per_m",),
)
