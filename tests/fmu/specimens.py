"""Models to export: a guided mass on a linear strut, with any law of the catalogue in it."""

import math
from collections.abc import Sequence

from dart_model.effects import CATALOGUE, Effect
from dart_model.effects.calling import force_over_arrays
from dart_model.effects.law import Motion
from dart_model.spec import MODELS, EffectSpec, ModelSpec, load_model

FORCE_N = 40.0
"""What an effect is to be worth."""

MOVES = Motion(
    low_m=0.24,
    high_m=0.36,
    speed_m_per_s=0.25,
    top_speed_m_per_s=0.4,
    least_stroke_m=0.12,
    duration_s=1.0,
    step_s=1e-3,
    free_length_m=0.5,
    stiffness_n_per_m=500.0,
    damping_n_s_per_m=100.0,
    mass_kg=10.0,
    force_n=FORCE_N,
    temperatures_c=(20.0, 40.0),
    tones=((3.0, 0.4),),
)
"""How the mass moves that is let go from `DISPLACED_M`."""

_TABLE_N = tuple(10.0 * math.sin(0.7 * k) for k in range(9 * 7))

_DAMPING = 25.0
"""A fifth of what would stop the mass from swinging: it goes through what a law has at the ends."""

DISPLACED_M = 0.38
"""Above where it rests, which is at 0.304 m."""


def worth(law: Effect) -> tuple[float, ...]:
    """Parameters of a law with which it matters on the bench: those that a search begins with."""
    if law.name == "restoring_surface":
        return (MOVES.low_m, MOVES.high_m, -1.0, 1.0, *_TABLE_N)
    starts = law.starts(MOVES)
    if not starts:
        return tuple(_middle(item.low, item.high) for item in law.parameters)
    p = list(starts[len(starts) // 2])
    shares = (-0.95, -0.6, -0.2, 0.3, 0.7, 0.95)
    forces = [_force(law, p, share) for share in shares]
    drives = sum(force * share for force, share in zip(forces, shares, strict=True)) > 0.0
    largest = max(map(abs, forces))
    for k in law.scaled:
        factor = (FORCE_N / largest) ** (1.0 / len(law.scaled)) if largest > 1e-9 else 1.0
        if drives and law.parameters[k].low < 0.0 and len(law.scaled) == 1:
            factor = -factor
        p[k] = min(max(p[k] * factor, law.parameters[k].low), law.parameters[k].high)
    return tuple(p)


def _force(law: Effect, p: Sequence[float], share: float) -> float:
    """Force somewhere on the motion, with internal states of their usual size."""
    height_m = MOVES.low_m + 0.5 * (1.0 + share) * MOVES.stroke_m
    velocity = MOVES.top_speed_m_per_s * math.copysign(math.sqrt(1.0 - share * share), share)
    strut = (MOVES.free_length_m, MOVES.stiffness_n_per_m, MOVES.damping_n_s_per_m, 9.81)
    force = force_over_arrays(law)
    return force(0.3, height_m, velocity, 20.0, 30.0, law.state_scales, p, strut)


def _middle(low: float, high: float) -> float:
    return min(max(20.0, low), high) if high < 1e6 else 20.0


def with_effects(*names: str) -> ModelSpec:
    """The reference model with laws of the catalogue in its strut."""
    effects = tuple(
        EffectSpec(name=name, parameters=CATALOGUE[name].named(worth(CATALOGUE[name])))
        for name in names
    )
    spec = load_model(MODELS / "reference.yaml")
    (strut,) = spec.struts
    struts = (strut.model_copy(update={"effects": effects, "damping_n_s_per_m": _DAMPING}),)
    return spec.model_copy(update={"struts": struts})
