"""Draws whole cases: `make_case(seed, kind)`.

Kinds: ``single`` (families in turn), any family's name, ``pair``, ``triple``, ``complete``,
``outside``, ``friction_and_cubic``, and ``foreign-FAMILY``: an effect of that family by a formula
that no catalogue holds.
"""

import zlib
from dataclasses import replace

import numpy as np

from tests.truth.excitation import load_n
from tests.truth.integrator import Motion
from tests.truth.plant import Bench, Case, Excitation, Planted, RunPlan, Sensors
from tests.truth.planting import DRAWS, FOREIGN, OUTSIDE, START_C, Draw, Nominal, Rng, cubic_spring
from tests.truth.simulation import true_motion

FAMILIES = tuple(DRAWS)
FOREIGN_KINDS = {f"foreign-{family}": family for family in FOREIGN}
KINDS = ("single", "pair", "triple", "complete", "outside", "friction_and_cubic", *FOREIGN_KINDS)
SHAPES = ("multisine", "sweep", "noise")
LOAD_LIMIT_N = 600.0
HEIGHT_LOW_M = 0.03
HEIGHT_HIGH_M = 1.0
LEAST_SWING_M = 0.008
PLANNING_RATE_HZ = 250
ATTEMPTS = 400


class _UnfitError(Exception):
    """This draw gives no bench that one could run; the next one may."""


def make_case(seed: int, kind: str) -> Case:
    """Draw a case.

    Args:
        seed: Any non-negative integer; equal seeds and kinds give equal cases.
        kind: See the module.

    Raises:
        ValueError: The kind is unknown.
    """
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), attempt])
        try:
            return _draw_case(rng, seed, kind)
        except _UnfitError:
            continue
    raise RuntimeError(f"no fit bench in {ATTEMPTS} draws for seed {seed}, kind {kind!r}")


def _draw_case(rng: Rng, seed: int, kind: str) -> Case:
    families = _families(rng, seed, kind)
    laws = FOREIGN if kind in FOREIGN_KINDS else DRAWS | {"outside": OUTSIDE}
    draws = [_pick(rng, laws[family]) for family in families]
    if kind == "friction_and_cubic":
        draws = [draws[0], cubic_spring]
    bench = _bench(rng, centred="backlash" in families)
    train = _run_plan(rng, bench, 1.0, centred="backlash" in families)
    nominal = _nominal(bench, train)
    effects = tuple(draw(rng, nominal, _strength(rng, len(draws), kind)) for draw in draws)
    held_out = _held_out_plan(rng, bench, train)
    sensors = Sensors(
        sample_rate_hz=1000 if rng.random() < 0.75 else 500,
        height_noise_m=float(10.0 ** rng.uniform(-6.0, -4.0)),
        has_temperature=any(e.law == "thin_oil" for e in effects) or rng.random() < 0.1,
    )
    for plan in (train, held_out):
        _refuse_unfit(bench, effects, plan)
    planted_laws = "+".join(effect.law for effect in effects) or "nothing"
    name = f"{kind}-{seed:04d}-{planted_laws}"
    planted = tuple(effect.family for effect in effects)
    return Case(name, kind, planted, effects, bench, sensors, train, held_out, seed)


def _families(rng: Rng, seed: int, kind: str) -> tuple[str, ...]:
    if kind in DRAWS:
        return (kind,)
    if kind == "single":
        return (FAMILIES[seed % len(FAMILIES)],)
    if kind in FOREIGN_KINDS:
        return (FOREIGN_KINDS[kind],)
    if kind in {"pair", "triple"}:
        count = 2 if kind == "pair" else 3
        return tuple(str(f) for f in rng.choice(FAMILIES, count, replace=False))
    fixed = {
        "complete": (),
        "outside": ("outside",),
        "friction_and_cubic": ("friction", "nonlinear_stiffness"),
    }
    if kind not in fixed:
        raise ValueError(f"kind {kind!r}: expected one of {', '.join([*KINDS, *DRAWS])}")
    return fixed[kind]


def _pick(rng: Rng, choices: tuple[Draw, ...]) -> Draw:
    return choices[int(rng.integers(len(choices)))]


def _strength(rng: Rng, count: int, kind: str) -> float:
    """Effect over load, from barely visible to dominant; several at once stay comparable."""
    low, high = (0.003, 0.7) if count == 1 else (0.03, 0.4)
    if kind == "outside":
        low = 0.05
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _bench(rng: Rng, *, centred: bool) -> Bench:
    mass = float(rng.uniform(5.0, 40.0))
    high_hz = 4.0 if rng.random() < 0.85 else 6.0
    natural_hz = float(np.exp(rng.uniform(np.log(0.8), np.log(high_hz))))
    omega = 2.0 * np.pi * natural_hz
    damping_ratio = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4))))
    free_length = float(rng.uniform(0.2, 0.6))
    bench = Bench(
        round(mass, 3),
        round(mass * omega**2, 2),
        round(2.0 * damping_ratio * mass * omega, 3),
        round(free_length, 4),
    )
    sag = 0.0 if centred else bench.weight_n / bench.stiffness_n_per_m
    if bench.free_length_m - sag < 0.1:
        raise _UnfitError
    return bench


def _run_plan(rng: Rng, bench: Bench, loudness: float, *, centred: bool) -> RunPlan:
    carried = rng.uniform(0.9, 1.1) if centred or rng.random() < 0.3 else rng.uniform(-0.1, 0.2)
    high_hz = float(np.clip(bench.natural_hz * rng.uniform(3.0, 6.0), 4.0, 12.0))
    unit = Excitation(
        shape=SHAPES[int(rng.integers(len(SHAPES)))],
        amplitude_n=1.0,
        bias_n=float(carried * bench.weight_n),
        low_hz=float(bench.natural_hz * rng.uniform(0.15, 0.4)),
        high_hz=high_hz,
        tilt=float(rng.uniform(0.3, 0.7)),
        duration_s=float(rng.integers(20, 31)),
        seed=int(rng.integers(1_000_000)),
    )
    swing = float(rng.uniform(0.03, 0.12))
    plan = _scaled(bench, unit, loudness * swing)
    offset = float(rng.uniform(-0.01, 0.01))
    return RunPlan(plan, offset, START_C, int(rng.integers(1_000_000)))


def _held_out_plan(rng: Rng, bench: Bench, train: RunPlan) -> RunPlan:
    """Another seed, often another shape, somewhat less swing, another start."""
    unit = Excitation(
        shape=SHAPES[int(rng.integers(len(SHAPES)))],
        amplitude_n=1.0,
        bias_n=train.excitation.bias_n,
        low_hz=train.excitation.low_hz,
        high_hz=train.excitation.high_hz,
        tilt=train.excitation.tilt,
        duration_s=float(rng.integers(15, 21)),
        seed=int(rng.integers(1_000_000)),
    )
    swing = _swing(bench, train.excitation) * float(rng.uniform(0.6, 0.95))
    ambient = START_C + float(rng.uniform(0.0, 5.0))
    offset = float(rng.uniform(-0.01, 0.01))
    return RunPlan(_scaled(bench, unit, swing), offset, ambient, int(rng.integers(1_000_000)))


def _dry(bristle: Planted) -> Planted:
    return replace(bristle, law="stick", truth=bristle.truth | {"hyperbolic": 0.0})


def _rough_motion(bench: Bench, effects: tuple[Planted, ...], plan: RunPlan) -> Motion:
    """The run in coarse steps, to plan with; stiff bristles are replaced by dry contact."""
    coarse = tuple(_dry(effect) if effect.law == "bristle" else effect for effect in effects)
    steps = (5000 if effects else 2500) // PLANNING_RATE_HZ
    return true_motion(bench, coarse, plan, PLANNING_RATE_HZ, steps)[1]


def _swing(bench: Bench, excitation: Excitation) -> float:
    """Half the stroke of the bench without effects."""
    motion = _rough_motion(bench, (), RunPlan(excitation, 0.0, START_C, 0))
    return float(np.ptp(motion.height_m)) / 2.0


def _scaled(bench: Bench, unit: Excitation, swing_m: float) -> Excitation:
    """The excitation that makes the bench without effects swing so far, or as the load allows."""
    reach = _swing(bench, unit)
    sag = (bench.weight_n - unit.bias_n) / bench.stiffness_n_per_m
    room = bench.free_length_m - sag - 0.06
    amplitude = min(swing_m, room) / reach
    t_s = np.arange(0.0, unit.duration_s, 0.004)
    crest = float(np.max(np.abs(load_n(unit, bench, t_s) - unit.bias_n)))
    amplitude = min(amplitude, (LOAD_LIMIT_N - abs(unit.bias_n)) / crest)
    if amplitude * reach < 0.015:
        raise _UnfitError
    return replace(unit, amplitude_n=amplitude)


def _nominal(bench: Bench, plan: RunPlan) -> Nominal:
    motion = _rough_motion(bench, (), plan)
    return Nominal(
        bench,
        plan.excitation,
        motion.height_m - bench.free_length_m,
        motion.velocity_m_per_s,
        motion.acceleration_m_per_s2,
        plan.excitation.amplitude_n,
    )


def _refuse_unfit(bench: Bench, effects: tuple[Planted, ...], plan: RunPlan) -> None:
    motion = _rough_motion(bench, effects, plan)
    z = motion.height_m
    if not np.all(np.isfinite(z)) or z.min() < HEIGHT_LOW_M or z.max() > HEIGHT_HIGH_M:
        raise _UnfitError
    # A body that friction holds fast, or a gas column at its end, tells nothing.
    settled = z[z.size // 10 :]
    if np.std(settled) < LEAST_SWING_M / 2.0 or np.abs(motion.force_n).max(initial=0.0) > 5e3:
        raise _UnfitError
