"""Every effect a model can be given, one file a family."""

import difflib
from collections.abc import Mapping
from types import MappingProxyType

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
from dart_model.effects.law import (
    Bench,
    Bounds,
    Effect,
    Floats,
    Force,
    Motion,
    Parameter,
    Rate,
    Start,
    Writable,
)
from dart_model.errors import ModelError

__all__ = [
    "AMBIENT_C",
    "CATALOGUE",
    "FAMILY_WORDS",
    "Bench",
    "Bounds",
    "Effect",
    "Floats",
    "Force",
    "Motion",
    "Parameter",
    "Rate",
    "Start",
    "UnknownEffectError",
    "Writable",
    "effect",
]

_ALL = (
    none.NONE,
    preload.PRELOAD,
    stiffness.LINEAR_STIFFNESS,
    damping.LINEAR_DAMPING,
    inertia.ADDED_MASS,
    inertia.INERTER,
    input_gain.INPUT_GAIN,
    nonlinear_stiffness.QUADRATIC_STIFFNESS,
    nonlinear_stiffness.CUBIC_STIFFNESS,
    nonlinear_stiffness.CENTRED_CUBIC_STIFFNESS,
    nonlinear_stiffness.POWER_STIFFNESS,
    nonlinear_stiffness.PROGRESSIVE_STIFFNESS,
    nonlinear_stiffness.EXPONENTIAL_STIFFNESS,
    nonlinear_stiffness.GAS_SPRING,
    nonlinear_stiffness.BALANCED_GAS_SPRING,
    stop.BUMP_STOP,
    stop.REBOUND_STOP,
    stop.HERTZ_BUMP_STOP,
    stop.HERTZ_REBOUND_STOP,
    stop.POWER_BUMP_STOP,
    stop.POWER_REBOUND_STOP,
    stop.END_STOPS,
    stop.HERTZ_END_STOPS,
    backlash.BACKLASH,
    backlash.FREE_PLAY,
    friction.COULOMB_FRICTION,
    friction.STRIBECK_FRICTION,
    friction.PRESLIDING_FRICTION,
    friction.ELASTOPLASTIC_FRICTION,
    friction.LUGRE_FRICTION,
    nonlinear_damping.QUADRATIC_DAMPING,
    nonlinear_damping.POWER_DAMPING,
    nonlinear_damping.ASYMMETRIC_DAMPING,
    nonlinear_damping.DIRECTIONAL_DAMPING,
    nonlinear_damping.DIGRESSIVE_DAMPING,
    nonlinear_damping.SATURATING_DAMPING,
    nonlinear_damping.ARCTAN_DAMPING,
    nonlinear_damping.BLOW_OFF_DAMPING,
    nonlinear_damping.SMOOTH_BLOW_OFF_DAMPING,
    nonlinear_damping.STROKE_DAMPING,
    nonlinear_damping.POSITION_DEPENDENT_DAMPING,
    nonlinear_damping.ZONE_DAMPING,
    nonlinear_damping.END_ZONE_DAMPING,
    hysteresis.BOUC_WEN,
    hysteresis.DAHL,
    hysteresis.GENERAL_BOUC_WEN,
    hysteresis.FRICTION_BEHIND_PLAY,
    hysteresis.IWAN,
    hysteresis.MAXWELL,
    fade.TEMPERATURE_FADE,
    fade.LINEAR_TEMPERATURE_FADE,
    fade.TIME_FADE,
    fade.ENERGY_FADE,
    delay.DELAY,
    periodic_force.PERIODIC_FORCE,
    unmodelled_mode.HIDDEN_MASS,
    restoring_surface.RESTORING_SURFACE,
)

CATALOGUE: Mapping[str, Effect] = MappingProxyType({item.name: item for item in _ALL})
"""Every effect by its name in a model file."""

FAMILY_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "preload": "a preload",
        "stiffness": "another stiffness",
        "damping": "another damping",
        "inertia": "another inertia",
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
        "restoring_surface": "a force over height and velocity without a name",
    }
)
"""Every family of effects as a phrase with its article."""


class UnknownEffectError(ModelError):
    """There is no effect of that name."""

    def __init__(self, name: str) -> None:
        self.name = name
        near = difflib.get_close_matches(name, CATALOGUE, n=3, cutoff=0.4)
        choices = ", ".join(near or sorted(CATALOGUE))
        super().__init__(f"effect {name!r}: expected one of {choices}")


def effect(name: str) -> Effect:
    """The effect called `name`.

    Raises:
        UnknownEffectError: There is none; the message names the nearest ones.
    """
    if name not in CATALOGUE:
        raise UnknownEffectError(name)
    return CATALOGUE[name]
