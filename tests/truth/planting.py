"""Draws the parameters of a planted effect, one function a family.

Every draw sees the motion of the bench without effects, so that an effect is sized against what
the bench does: a stop lies inside the stroke, a blow-off below the highest velocity.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tests.truth.compiled import REFERENCE_C
from tests.truth.plant import Bench, Excitation, Planted, Samples

Rng = np.random.Generator


class Nominal(NamedTuple):
    """The bench without effects.

    Attributes:
        bench: The bench.
        excitation: Its load.
        x_m: (n,) height over the free length.
        v_m_per_s: (n,) velocity.
        a_m_per_s2: (n,) acceleration.
        load_rms_n: RMS of the load about its mean: what an effect's strength is measured in.
    """

    bench: Bench
    excitation: Excitation
    x_m: Samples
    v_m_per_s: Samples
    a_m_per_s2: Samples
    load_rms_n: float

    def coefficient(self, strength: float, shape: Samples) -> float:
        """Factor that makes the shape's swing as strong as `strength` times the load's."""
        return strength * self.load_rms_n / float(np.std(shape))


Draw = Callable[[Rng, Nominal, float], Planted]


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _side(rng: Rng) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _preload(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    force = _side(rng) * min(strength * nominal.load_rms_n, 0.5 * nominal.bench.weight_n)
    return Planted("preload", "constant", {"force_n": force})


def _stiffness(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    size = min(nominal.coefficient(strength, nominal.x_m), 0.4 * nominal.bench.stiffness_n_per_m)
    return Planted("stiffness", "stiffness_error", {"stiffness_n_per_m": _side(rng) * size})


def _damping(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    side = _side(rng)
    limit = (3.0 if side > 0.0 else 0.6) * nominal.bench.damping_n_s_per_m
    size = min(nominal.coefficient(strength, nominal.v_m_per_s), limit)
    return Planted("damping", "damping_error", {"damping_n_s_per_m": side * size})


def _inertia(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    side = _side(rng)
    limit = (0.5 if side > 0.0 else 0.3) * nominal.bench.mass_kg
    size = min(nominal.coefficient(strength, nominal.a_m_per_s2), limit)
    return Planted("inertia", "rigid_mass", {"mass_kg": side * size})


def _input_gain(rng: Rng, _: Nominal, strength: float) -> Planted:
    return Planted("input_gain", "load_scale", {"fraction": _side(rng) * min(strength, 0.4)})


def _square(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    # A falling stiffness must not make the bench unstable within its stroke.
    size = nominal.coefficient(strength, nominal.x_m**2)
    limit = 0.25 * nominal.bench.stiffness_n_per_m / float(np.max(np.abs(nominal.x_m)))
    side = _side(rng)
    return Planted(
        "nonlinear_stiffness", "square_spring", {"stiffness_n_per_m2": side * min(size, limit)}
    )


def _cube(_: Rng, nominal: Nominal, strength: float) -> Planted:
    size = nominal.coefficient(strength, nominal.x_m**3)
    return Planted("nonlinear_stiffness", "cube_spring", {"stiffness_n_per_m3": size})


def _power(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    reach, exponent = 0.1, float(rng.uniform(2.3, 3.8))
    shape = np.sign(nominal.x_m) * (np.abs(nominal.x_m) / reach) ** exponent
    size = nominal.coefficient(strength, shape)
    truth = {"force_at_reach_n": size, "reach_m": reach, "exponent": exponent}
    return Planted("nonlinear_stiffness", "power_spring", truth)


def _exponential(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    stroke = float(np.ptp(nominal.x_m))
    length = stroke * float(rng.uniform(0.15, 0.4))
    size = nominal.coefficient(strength, np.expm1(-nominal.x_m / length))
    truth = {"force_n": size, "length_m": length}
    return Planted("nonlinear_stiffness", "exponential_spring", truth)


def _gas(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    # The column is longer than the deepest compression, with room for what the effect changes.
    deepest = max(0.02, -float(np.min(nominal.x_m)))
    column = deepest * float(rng.uniform(1.4, 2.2))
    exponent = float(rng.uniform(1.0, 1.4))
    charge = 1.0 if rng.random() < 0.4 else _log(rng, 1.5, 8.0)
    shape = charge * (column / (column + nominal.x_m)) ** exponent
    truth = {
        "area_force_n": nominal.coefficient(strength, shape),
        "column_m": column,
        "exponent": exponent,
        "charge_ratio": charge,
    }
    return Planted("nonlinear_stiffness", "gas_column", truth)


def _set_up(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    spread = float(np.std(nominal.x_m))
    centre = float(np.median(nominal.x_m)) + spread * float(rng.uniform(-0.5, 0.5))
    half_width = spread * _log(rng, 0.1, 0.7)
    shape = np.clip((nominal.x_m - centre) / half_width, -1.0, 1.0)
    size = nominal.coefficient(strength, shape)
    truth = {"force_n": size, "centre_m": centre, "half_width_m": half_width}
    return Planted("nonlinear_stiffness", "set_up_spring", truth)


def _stop(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    # Reached at the outer 3 to 25 % of the swing, on one side or on both.
    z = nominal.x_m + nominal.bench.free_length_m
    middle, swing = float(np.median(z)), float(np.ptp(z)) / 2.0
    low = middle - swing * float(rng.uniform(0.5, 0.9))
    high = middle + swing * float(rng.uniform(0.5, 0.9))
    which = rng.integers(3)
    ends = {"low_m": low if which != 1 else -1.0, "high_m": high if which != 0 else 9.0}
    stiffness = nominal.bench.stiffness_n_per_m * (2.0 + 60.0 * strength)
    if rng.random() < 0.5:
        truth = ends | {
            "stiffness_n_per_m15": float(stiffness / np.sqrt(0.1 * swing)),
            "dissipation_s_per_m": float(rng.uniform(0.0, 0.5)),
        }
        return Planted("stop", "hertz_bumper", truth)
    critical = 2.0 * float(np.sqrt(stiffness * nominal.bench.mass_kg))
    truth = ends | {
        "stiffness_n_per_m": stiffness,
        "damping_n_s_per_m": critical * float(rng.uniform(0.0, 0.3)),
    }
    return Planted("stop", "linear_bumper", truth)


def _backlash(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    gap = float(np.ptp(nominal.x_m)) * min(0.25, 0.03 + 0.5 * strength) * rng.uniform(0.7, 1.0)
    return Planted("backlash", "free_play", {"half_gap_m": float(gap)})


def _friction(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    coulomb = strength * nominal.load_rms_n
    truth = {
        "coulomb_n": coulomb,
        "breakaway_n": coulomb * (1.0 if rng.random() < 0.4 else float(rng.uniform(1.1, 1.6))),
        "stribeck_m_per_s": _log(rng, 0.01, 0.1),
    }
    if rng.random() < 0.5:
        return Planted("friction", "stick", truth | {"hyperbolic": 0.0})
    return Planted("friction", "bristle", truth | {"bristle_m": _log(rng, 2e-5, 1e-4)})


def _orifice(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    exponent = 2.0 if rng.random() < 0.5 else 1.75
    v = nominal.v_m_per_s
    size = nominal.coefficient(strength, np.sign(v) * np.abs(v) ** exponent)
    truth = {"force_at_1_m_per_s_n": size, "exponent": exponent}
    return Planted("nonlinear_damping", "orifice", truth)


def _one_way(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    side = _side(rng)
    size = nominal.coefficient(strength, np.maximum(0.0, nominal.v_m_per_s))
    truth = {"damping_n_s_per_m": size, "side": side}
    return Planted("nonlinear_damping", "one_way", truth)


def _arctan(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    knee = float(np.std(nominal.v_m_per_s)) * _log(rng, 0.25, 0.9)
    size = nominal.coefficient(strength, np.arctan(nominal.v_m_per_s / knee) * 2.0 / np.pi)
    truth = {"force_n": size, "velocity_m_per_s": knee}
    return Planted("nonlinear_damping", "arctan_damper", truth)


def _blow_off(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    v = nominal.v_m_per_s
    knee = float(np.std(v)) * float(rng.uniform(0.3, 1.0))
    size = nominal.coefficient(strength, np.sign(v) * np.maximum(0.0, np.abs(v) - knee))
    truth = {
        "damping_drop_n_s_per_m": min(size, 0.85 * nominal.bench.damping_n_s_per_m),
        "knee_m_per_s": knee,
    }
    return Planted("nonlinear_damping", "blow_off", truth)


def _taper(_: Rng, nominal: Nominal, strength: float) -> Planted:
    shape = np.maximum(0.0, -nominal.x_m) * nominal.v_m_per_s
    truth = {"damping_n_s_per_m2": nominal.coefficient(strength, shape)}
    return Planted("nonlinear_damping", "taper", truth)


def _groove(_: Rng, nominal: Nominal, strength: float) -> Planted:
    shape = nominal.x_m**2 * nominal.v_m_per_s
    truth = {"damping_n_s_per_m3": nominal.coefficient(strength, shape)}
    return Planted("nonlinear_damping", "groove", truth)


def _hysteresis(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    swing = float(np.std(nominal.x_m))
    if rng.random() < 0.25:
        relaxation = _log(rng, 0.2, 3.0) / (2.0 * np.pi * nominal.bench.natural_hz)
        stiffness = min(nominal.coefficient(strength, nominal.x_m), nominal.bench.stiffness_n_per_m)
        truth = {"stiffness_n_per_m": stiffness, "relaxation_s": relaxation}
        return Planted("hysteresis", "relaxing_branch", truth)
    limit = strength * nominal.load_rms_n
    truth = {"stiffness_n_per_m": limit / (swing * _log(rng, 0.08, 0.6)), "yield_n": limit}
    draw = rng.random()
    if draw < 0.35:
        more = {"exponent": float(rng.uniform(1.0, 3.0)), "softness": float(rng.uniform(0.5, 1.0))}
        return Planted("hysteresis", "yielding", truth | more)
    if draw < 0.7:
        return Planted("hysteresis", "dahl", truth | {"exponent": float(rng.uniform(0.7, 1.6))})
    return Planted("hysteresis", "slip_elements", truth | {"grading": 1.0})


def _fade(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    lost = min(0.75, 0.05 + 1.5 * strength)
    duration = nominal.excitation.duration_s
    energy = nominal.bench.damping_n_s_per_m * float(np.mean(nominal.v_m_per_s**2)) * duration
    draw = rng.random()
    if draw < 0.4:
        rise = float(rng.uniform(15.0, 50.0))
        truth = {
            "per_k": -float(np.log1p(-lost)) / rise,
            "heat_capacity_j_per_k": 0.7 * energy / rise,
            "cooling_s": _log(rng, 20.0, 100.0),
        }
        return Planted("fade", "thin_oil", truth)
    if draw < 0.7:
        truth = {
            "lost_fraction": lost,
            "time_s": duration * _log(rng, 0.15, 0.7),
            "stretch": 1.0,
        }
        return Planted("fade", "time_fade", truth)
    truth = {"lost_fraction": lost, "energy_j": energy * _log(rng, 0.15, 0.7)}
    return Planted("fade", "work_fade", truth)


def _delay(_: Rng, nominal: Nominal, strength: float) -> Planted:
    # The load's derivative is about its RMS times 2 pi times the middle of its band.
    middle_hz = float(np.sqrt(nominal.excitation.low_hz * nominal.excitation.high_hz))
    lag = strength / (2.0 * np.pi * middle_hz)
    return Planted("delay", "late_load", {"lag_s": float(np.clip(lag, 5e-4, 0.02))})


def _periodic(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "force_n": 1.414 * strength * nominal.load_rms_n,
        "frequency_hz": _log(rng, 1.0, 20.0),
        "phase_rad": float(rng.uniform(-np.pi, np.pi)),
    }
    return Planted("periodic_force", "tone", truth)


def _mode(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    # Its resonance lies inside the excited band; above it, it would be no more than a mass.
    low, high = 1.2 * nominal.bench.natural_hz, 0.85 * nominal.excitation.high_hz
    truth = {
        "mass_kg": nominal.bench.mass_kg * min(0.3, max(0.01, 0.5 * strength)),
        "frequency_hz": _log(rng, low, max(1.1 * low, high)),
        "damping_ratio": _log(rng, 0.01, 0.1),
    }
    return Planted("unmodelled_mode", "hung_mass", truth)


def _cogging(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "force_n": strength * nominal.load_rms_n,
        "pitch_m": float(np.ptp(nominal.x_m)) / float(rng.uniform(4.0, 12.0)),
        "phase_rad": float(rng.uniform(-np.pi, np.pi)),
    }
    return Planted("outside", "cogging", truth)


def _ripple(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "damping_n_s_per_m": nominal.coefficient(strength, nominal.v_m_per_s),
        "pitch_m": float(np.ptp(nominal.x_m)) / float(rng.uniform(4.0, 10.0)),
        "phase_rad": float(rng.uniform(-np.pi, np.pi)),
    }
    return Planted("outside", "ripple_damping", truth)


def _fractional(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    order = float(rng.uniform(0.35, 0.65))
    omega = 2.0 * np.pi * nominal.bench.natural_hz
    # The ladder's sum over a decade ratio r stands for an integral: about pi / (sin ln r) more.
    size = nominal.coefficient(strength, nominal.x_m) / (3.8 * omega**order)
    return Planted("outside", "fractional", {"coefficient_n": size, "order": order})


def _wander(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "force_n": strength * nominal.load_rms_n,
        "bandwidth_hz": float(rng.uniform(1.0, 6.0)),
        "draw": float(rng.integers(1_000_000)),
    }
    return Planted("outside", "wander", truth)


def _chaos(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "force_n": strength * nominal.load_rms_n,
        "speed_per_s": float(rng.uniform(1.0, 4.0)),
        "draw": float(rng.integers(1_000_000)),
    }
    return Planted("outside", "chaos", truth)


def _accel_square(_: Rng, nominal: Nominal, strength: float) -> Planted:
    size = nominal.coefficient(strength, nominal.a_m_per_s2 * np.abs(nominal.a_m_per_s2))
    return Planted("outside", "accel_square", {"coefficient_n_s4_per_m2": size})


def _switching(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    size = min(nominal.coefficient(strength, nominal.x_m), 0.5 * nominal.bench.stiffness_n_per_m)
    truth = {
        "stiffness_n_per_m": size,
        "mean_time_s": float(rng.uniform(0.5, 2.0)),
        "draw": float(rng.integers(1_000_000)),
    }
    return Planted("outside", "gated_spring", truth)


def _pumped(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    size = min(nominal.coefficient(strength, nominal.x_m), 0.4 * nominal.bench.stiffness_n_per_m)
    # Away from twice the natural frequency, where the bench would run off.
    frequency = nominal.bench.natural_hz * float(rng.uniform(0.15, 0.6))
    truth = {"stiffness_n_per_m": size, "frequency_hz": frequency}
    return Planted("outside", "gated_spring", truth)


def _detent(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    spread = float(np.std(nominal.x_m))
    truth = {
        "force_n": strength * nominal.load_rms_n * 2.0,
        "centre_m": float(np.median(nominal.x_m)) + spread * float(rng.uniform(-0.7, 0.7)),
        "width_m": spread * float(rng.uniform(0.12, 0.3)),
    }
    return Planted("outside", "detent", truth)


def _hyperbolic(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    coulomb = strength * nominal.load_rms_n
    truth = {
        "coulomb_n": coulomb,
        "breakaway_n": coulomb * float(rng.uniform(1.2, 1.6)),
        "stribeck_m_per_s": _log(rng, 0.02, 0.1),
        "hyperbolic": 1.0,
    }
    return Planted("friction", "stick", truth)


def _rubber(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    z = nominal.x_m + nominal.bench.free_length_m
    swing = float(np.ptp(z)) / 2.0
    truth = {
        "low_m": float(np.median(z)) - swing * float(rng.uniform(0.5, 0.8)),
        "high_m": 9.0,
        "stiffness_n_per_m": nominal.bench.stiffness_n_per_m * (1.0 + 20.0 * strength),
        "length_m": swing * float(rng.uniform(0.15, 0.4)),
    }
    return Planted("stop", "rubber_bumper", truth)


def _soft_play(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    gap = _backlash(rng, nominal, strength).truth["half_gap_m"]
    return Planted("backlash", "soft_play", {"half_gap_m": gap})


def _tangent(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    limit = float(np.max(np.abs(nominal.x_m))) * float(rng.uniform(1.2, 1.6))
    u = 0.5 * np.pi * nominal.x_m / limit
    truth = {"force_n": nominal.coefficient(strength, np.tan(u) - u), "limit_m": limit}
    return Planted("nonlinear_stiffness", "tangent_spring", truth)


def _mixed(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    v = nominal.v_m_per_s
    truth = {
        "rebound_n": strength * nominal.load_rms_n * 1.4,
        "knee_m_per_s": float(np.std(v)) * float(rng.uniform(0.3, 0.9)),
        "compression_n_s2_per_m2": nominal.coefficient(strength, np.minimum(v, 0.0) ** 2),
    }
    return Planted("nonlinear_damping", "mixed_damper", truth)


def _graded(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    limit = strength * nominal.load_rms_n
    truth = {
        "stiffness_n_per_m": limit / (float(np.std(nominal.x_m)) * _log(rng, 0.1, 0.5)),
        "yield_n": limit,
        "grading": 0.0 if rng.random() < 0.5 else 2.5,
    }
    return Planted("hysteresis", "slip_elements", truth)


def _stretched(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    truth = {
        "lost_fraction": min(0.75, 0.05 + 1.5 * strength),
        "time_s": nominal.excitation.duration_s * _log(rng, 0.15, 0.5),
        "stretch": float(rng.uniform(0.5, 0.7)),
    }
    return Planted("fade", "time_fade", truth)


def _overtone(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    tone = _periodic(rng, nominal, strength)
    truth = dict(tone.truth, frequency_hz=tone.truth["frequency_hz"] / 2.0)
    truth |= {"overtone": float(rng.uniform(0.2, 0.5)), "overtone_rad": float(rng.uniform(0, 6))}
    return Planted("periodic_force", "tone", truth)


DRAWS: dict[str, tuple[Draw, ...]] = {
    "preload": (_preload,),
    "stiffness": (_stiffness,),
    "damping": (_damping,),
    "inertia": (_inertia,),
    "input_gain": (_input_gain,),
    "nonlinear_stiffness": (_square, _cube, _power, _exponential, _gas, _set_up),
    "stop": (_stop,),
    "backlash": (_backlash,),
    "friction": (_friction,),
    "nonlinear_damping": (_orifice, _one_way, _arctan, _blow_off, _taper, _groove),
    "hysteresis": (_hysteresis,),
    "fade": (_fade,),
    "delay": (_delay,),
    "periodic_force": (_periodic,),
    "unmodelled_mode": (_mode,),
}
"""Family -> how its laws are drawn; one of them is picked for a case."""

OUTSIDE: tuple[Draw, ...] = (
    _cogging,
    _ripple,
    _fractional,
    _wander,
    _chaos,
    _accel_square,
    _switching,
    _pumped,
    _detent,
)
"""Forces that no catalogue of strut effects holds."""

FOREIGN: dict[str, tuple[Draw, ...]] = {
    "nonlinear_stiffness": (_tangent,),
    "stop": (_rubber,),
    "backlash": (_soft_play,),
    "friction": (_hyperbolic,),
    "nonlinear_damping": (_mixed,),
    "hysteresis": (_graded,),
    "fade": (_stretched,),
    "periodic_force": (_overtone,),
}
"""Family -> laws that no catalogue may hold.

They show whether a family is recognised when the strut follows no formula that was written down.
"""

START_C = REFERENCE_C


def cubic_spring(rng: Rng, nominal: Nominal, strength: float) -> Planted:
    """A cubic spring, whatever the family's other laws."""
    return _cube(rng, nominal, strength)
