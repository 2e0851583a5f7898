"""Constitutive laws of the bench's undeclared effects, as compiled functions.

Each gives a force in N, positive when it pushes the strut's two bodies apart, unless it says
otherwise. No law is shared with any other package.

References:
    Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with friction",
    IEEE TAC 40 (1995): friction as a bristle.
    Hunt, Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", J. Appl.
    Mech. 42 (1975): stops.
    Ikhouane, Rodellar, "Systems with Hysteresis" (2007): Bouc-Wen.
"""

import math
from enum import IntEnum, unique

from rig.simulated_bench.compilation import Floats, jit_compile


@unique
class LawCode(IntEnum):
    """Codes of the laws in compiled code; those of the same inputs stand together."""

    PRELOAD = 0
    LINEAR_STIFFNESS = 1
    QUADRATIC_STIFFNESS = 2
    CUBIC_STIFFNESS = 3
    PROGRESSIVE_STIFFNESS = 4
    GAS_SPRING = 5
    BUMP_STOP = 6
    REBOUND_STOP = 7
    BACKLASH = 8
    LINEAR_DAMPING = 9
    QUADRATIC_DAMPING = 10
    ASYMMETRIC_DAMPING = 11
    DIGRESSIVE_DAMPING = 12
    POSITION_DEPENDENT_DAMPING = 13
    FRICTION = 14
    BOUC_WEN = 15
    MAXWELL = 16
    PERIODIC_FORCE = 17
    TEMPERATURE_FADE = 18
    TIME_FADE = 19
    HIDDEN_MASS = 20
    ADDED_MASS = 21
    INPUT_GAIN = 22
    DELAY = 23


@jit_compile
def progressive_stiffness(deflection_m: float, force_n: float, length_m: float) -> float:
    """Force of a spring that stiffens exponentially on both sides of its free length."""
    ratio = deflection_m / length_m
    return -force_n * (math.sinh(ratio) - ratio)


@jit_compile
def gas_spring(
    deflection_m: float, charge_force_n: float, gas_length_m: float, polytropic_exponent: float
) -> float:
    """Force of a column of gas; a column shorter than 1 % of its length is held at that."""
    length_m = max(gas_length_m + deflection_m, 0.01 * gas_length_m)
    return charge_force_n * (gas_length_m / length_m) ** polytropic_exponent


@jit_compile
def stop(
    depth_m: float,
    closing_m_per_s: float,
    contact_stiffness_n_per_m1_5: float,
    dissipation_s_per_m: float,
) -> float:
    """Force of a contact (Hunt, Crossley) out of it; it never pulls."""
    if depth_m <= 0.0:
        return 0.0
    force_n = (
        contact_stiffness_n_per_m1_5 * depth_m**1.5 * (1.0 + dissipation_s_per_m * closing_m_per_s)
    )
    return max(force_n, 0.0)


@jit_compile
def backlash(
    height_m: float, centre_height_m: float, gap_m: float, stiffness_n_per_m: float
) -> float:
    """Force of a spring in a link with free play about a height."""
    off_centre_m = height_m - centre_height_m
    beyond_m = max(abs(off_centre_m) - 0.5 * gap_m, 0.0)
    return -stiffness_n_per_m * math.copysign(beyond_m, off_centre_m)


@jit_compile
def digressive_damping(
    velocity_m_per_s: float, damping_n_s_per_m: float, knee_velocity_m_per_s: float
) -> float:
    """Force of a damper whose curve flattens beyond a knee."""
    return (
        -damping_n_s_per_m
        * velocity_m_per_s
        / math.sqrt(1.0 + (velocity_m_per_s / knee_velocity_m_per_s) ** 2)
    )


@jit_compile
def bristle_rate(
    velocity_m_per_s: float,
    bristle_m: float,
    presliding_m: float,
    static_to_coulomb: float,
    stribeck_velocity_m_per_s: float,
) -> float:
    """Rate in m/s at which the bristle of a friction deflects (LuGre)."""
    ratio = velocity_m_per_s / stribeck_velocity_m_per_s
    level = 1.0 + (static_to_coulomb - 1.0) * math.exp(-ratio * ratio)
    return velocity_m_per_s - abs(velocity_m_per_s) * bristle_m / (presliding_m * level)


@jit_compile
def bouc_wen_rate(
    velocity_m_per_s: float, elastic_m: float, yield_m: float, exponent: float, shape: float
) -> float:
    """Rate in m/s of a Bouc-Wen element's elastic deflection."""
    ratio = abs(elastic_m / yield_m) ** exponent
    same_way = 1.0 if velocity_m_per_s * elastic_m > 0.0 else -1.0
    return velocity_m_per_s * (1.0 - ratio * (shape * same_way + 1.0 - shape))


@jit_compile
def spring_force(law: int, p: Floats, deflection_m: float) -> float:
    """Force of a law of the deflection from the free length; `p` as of `EFFECT_KINDS`."""
    if law == LawCode.PRELOAD:
        return p[0]
    if law == LawCode.LINEAR_STIFFNESS:
        return -p[0] * deflection_m
    if law == LawCode.QUADRATIC_STIFFNESS:
        return -p[0] * deflection_m**2
    if law == LawCode.CUBIC_STIFFNESS:
        return -p[0] * deflection_m**3
    if law == LawCode.PROGRESSIVE_STIFFNESS:
        return progressive_stiffness(deflection_m, p[0], p[1])
    return gas_spring(deflection_m, p[0], p[1], p[2])


@jit_compile
def contact_force(law: int, p: Floats, height_m: float, velocity_m_per_s: float) -> float:
    """Force of a stop, or of a link with free play; `p` as of `EFFECT_KINDS`."""
    if law == LawCode.BACKLASH:
        return backlash(height_m, p[0], p[1], p[2])
    outwards = 1.0 if law == LawCode.BUMP_STOP else -1.0
    return outwards * stop(outwards * (p[0] - height_m), -outwards * velocity_m_per_s, p[1], p[2])


@jit_compile
def damping_force(law: int, p: Floats, deflection_m: float, velocity_m_per_s: float) -> float:
    """Force of a law that opposes the rate of height; `p` as of `EFFECT_KINDS`."""
    if law == LawCode.LINEAR_DAMPING:
        return -p[0] * velocity_m_per_s
    if law == LawCode.QUADRATIC_DAMPING:
        return -p[0] * abs(velocity_m_per_s) * velocity_m_per_s
    if law == LawCode.ASYMMETRIC_DAMPING:
        return -(p[1] if velocity_m_per_s > 0.0 else p[0]) * velocity_m_per_s
    if law == LawCode.DIGRESSIVE_DAMPING:
        return digressive_damping(velocity_m_per_s, p[0], p[1])
    return -p[0] * (deflection_m / p[1]) ** 2 * velocity_m_per_s


@jit_compile
def state_rate(law: int, p: Floats, velocity_m_per_s: float, state: float) -> float:
    """Rate of the internal state of a law; `p` as of `EFFECT_KINDS`.

    The state is the bristle's deflection in m (friction), the elastic deflection in m (Bouc-Wen) or
    the force in N (Maxwell).
    """
    if law == LawCode.FRICTION:
        return bristle_rate(velocity_m_per_s, state, p[1], p[2], p[3])
    if law == LawCode.BOUC_WEN:
        return bouc_wen_rate(velocity_m_per_s, state, p[1], p[2], p[3])
    return p[0] * velocity_m_per_s - state / p[1]


@jit_compile
def state_force(law: int, p: Floats, state: float, rate: float) -> float:
    """Force of a law with an internal state, from the state and its rate."""
    if law == LawCode.FRICTION:
        return -(p[0] / p[1] * state + p[4] * rate)
    if law == LawCode.BOUC_WEN:
        return -p[0] * state
    return -state


@jit_compile
def fade(law: int, p: Floats, t_s: float, temperature_c: float) -> float:
    """Factor on the damper curve, over temperature or time; 1 for a law that fades nothing."""
    if law == LawCode.TEMPERATURE_FADE:
        return math.exp(-p[0] * (temperature_c - p[1]))
    if law == LawCode.TIME_FADE:
        return p[0] + (1.0 - p[0]) * math.exp(-t_s / p[1])
    return 1.0
