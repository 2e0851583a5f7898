"""Preload: a constant force, such as gas preload, unaccounted weight or a load cell's offset."""

from dart_model.effects.law import Effect, Parameter


def _constant(force_n: float) -> float:
    return force_n


PRELOAD = Effect(
    name="preload",
    family="preload",
    words="a constant preload",
    parameters=(
        Parameter(
            "force_n", "N", -1e12, 1e12, "constant force, positive when it pushes the ends apart"
        ),
    ),
    force=_constant,
    excitation="a height whose zero is known",
    reference="Dixon, The Shock Absorber Handbook (2007), gas preload",
    linear=True,
    shown=("force_n",),
)
