"""Every effect a model can be given, one file a family."""

from collections.abc import Mapping
from types import MappingProxyType

from can_dbc.errors import expected_name
from dart_model.effects import (
    backlash,
    damping,
    delay,
    fade,
    friction,
    hysteresis,
    inertia,
    input_gain,
    none,
    nonlinear_damping,
    nonlinear_stiffness,
    periodic_force,
    preload,
    restoring_surface,
    stiffness,
    stop,
    unmodelled_mode,
)
from dart_model.effects.fade import AMBIENT_C
from dart_model.effects.law import Bench, Effect, Motion, Parameter
from dart_model.errors import ModelError

__all__ = [
    "AMBIENT_C", "CATALOGUE", "FAMILY_WORDS", "Bench", "Effect", "Motion", "Parameter",
    "UnknownEffectError", "effect",
]  # fmt: skip

_FAMILIES = (
    none, preload, stiffness, damping, inertia, input_gain, nonlinear_stiffness, stop, backlash,
    friction, nonlinear_damping, hysteresis, fade, delay, periodic_force, unmodelled_mode,
    restoring_surface,
)  # fmt: skip

CATALOGUE: Mapping[str, Effect] = MappingProxyType(
    {
        item.name: item
        for family in _FAMILIES
        for item in vars(family).values()
        if isinstance(item, Effect)
    }
)
"""Every effect by its name in a model file, in the order of the families' files."""

FAMILY_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "preload": "a preload",
        "stiffness": "a different stiffness",
        "damping": "a different damping",
        "inertia": "a different inertia",
        "input_gain": "a wrong gain of the applied force",
        "nonlinear_stiffness": "a non-linear spring",
        "stop": "an end stop",
        "backlash": "free play",
        "friction": "friction",
        "nonlinear_damping": "a non-linear damper",
        "hysteresis": "hysteresis",
        "fade": "fade of the damper",
        "delay": "a delay between the channels",
        "periodic_force": "a periodic force",
        "unmodelled_mode": "a further mass on a spring",
        "restoring_surface": "a restoring-force surface",
    }
)
"""Every family of effects as a phrase with its article."""


class UnknownEffectError(ModelError):
    """There is no effect of that name."""

    def __init__(self, name: str) -> None:
        self.name = name
        super().__init__(f"effect {name!r}: {expected_name(name, sorted(CATALOGUE))}")


def effect(name: str) -> Effect:
    """The effect called `name`.

    Raises:
        UnknownEffectError: There is none; the message names the nearest ones.
    """
    if name not in CATALOGUE:
        raise UnknownEffectError(name)
    return CATALOGUE[name]
