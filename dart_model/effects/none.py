"""No effect: the trivial partner of all others."""

from dart_model.effects.law import Effect


def _nothing() -> float:
    return 0.0


NONE = Effect(
    name="none",
    family="none",
    words="nothing",
    parameters=(),
    force=_nothing,
    excitation="none",
    reference="-",
    scaled=(),
)
