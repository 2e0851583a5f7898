"""Draws whole cases: `make_case(seed, kind)`.

Kinds: ``single`` (families in turn), any family's name, ``pair``, ``triple``, ``complete``,
``disturbed`` (complete, but the noise is coloured and the height late), ``outside``,
``friction_and_cubic``, and ``foreign-FAMILY``: an effect of that family by a formula
that no catalogue holds.

``rough_KIND`` is such a case whose model file is rough in all that is linear, so that only what is
not linear is planted; ``dyno_KIND`` is one whose motion is prescribed, the model file rough or not.
"""

import zlib
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tests.truth import dyno
from tests.truth.excitation import load_n
from tests.truth.integrator import Motion
from tests.truth.plant import Bench, Case, Excitation, Planted, Roughness, RunPlan, Sensors
from tests.truth.planting import DRAWS, FOREIGN, OUTSIDE, START_C, Draw, Nominal, Rng, cubic_spring
from tests.truth.simulation import true_motion

FAMILIES = tuple(DRAWS)
FOREIGN_KINDS = {f"foreign-{family}": family for family in FOREIGN}
LINEAR_FAMILIES = ("preload", "stiffness", "damping", "inertia", "input_gain")
NONLINEAR_FAMILIES = tuple(family for family in FAMILIES if family not in LINEAR_FAMILIES)
KINDS = (
    *("single", "pair", "triple", "complete", "disturbed", "outside", "friction_and_cubic"),
    *FOREIGN_KINDS,
)
SHAPES = ("multisine", "sweep", "noise")
LOAD_LIMIT_N = 600.0
HEIGHT_LOW_M = 0.03
HEIGHT_HIGH_M = 1.0
LEAST_SWING_M = 0.008
PLANNING_RATE_HZ = 250
ATTEMPTS = 400
GAIN_ERROR_SHARE = 1.0 / 3.0
DYNO_ROUGH_SHARE = 0.5


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


class _Recipe(NamedTuple):
    """A kind, taken apart.

    Attributes:
        base: The kind of what is planted.
        is_dyno: Whether the motion is prescribed.
        is_rough: Whether the model file is rough.
    """

    base: str
    is_dyno: bool
    is_rough: bool

    @property
    def families(self) -> tuple[str, ...]:
        """What may be planted; roughness is linear already."""
        shown = dyno.FAMILIES if self.is_dyno else FAMILIES
        return tuple(f for f in shown if not self.is_rough or f in NONLINEAR_FAMILIES)


def _recipe(rng: Rng, kind: str) -> _Recipe:
    setting, _, base = kind.partition("_")
    if setting == "rough":
        return _Recipe(base, is_dyno=False, is_rough=True)
    if setting == "dyno":
        rough = rng.random() < DYNO_ROUGH_SHARE and base not in LINEAR_FAMILIES
        return _Recipe(base, is_dyno=True, is_rough=rough)
    return _Recipe(kind, is_dyno=False, is_rough=False)


def _draw_case(rng: Rng, seed: int, kind: str) -> Case:
    recipe = _recipe(rng, kind)
    base = recipe.base
    families = _families(rng, seed, recipe)
    laws = FOREIGN if base in FOREIGN_KINDS else DRAWS | {"outside": OUTSIDE}
    draws = [_pick(rng, laws[family]) for family in families]
    if base == "friction_and_cubic":
        draws = [draws[0], cubic_spring]
    centred = "backlash" in families
    bench, train, nominal = (_dyno if recipe.is_dyno else _free_bench)(rng, centred=centred)
    effects = tuple(draw(rng, nominal, _strength(rng, len(draws), base)) for draw in draws)
    if recipe.is_dyno:
        held_out = dyno.draw_held_out(rng, train)
    else:
        held_out = _held_out_plan(rng, bench, train)
    sensors = _sensors(rng, recipe, effects)
    case = Case(
        name=f"{kind}-{seed:04d}-{'+'.join(effect.law for effect in effects) or 'nothing'}",
        kind=kind,
        families=("delay",) if sensors.late_s else tuple(effect.family for effect in effects),
        effects=effects,
        bench=bench,
        sensors=sensors,
        train=train,
        held_out=held_out,
        seed=seed,
        roughness=_roughness(rng, recipe, nominal),
    )
    for plan in (train, held_out):
        _refuse_unfit(case, plan)
    return case


def _free_bench(rng: Rng, *, centred: bool) -> tuple[Bench, RunPlan, Nominal]:
    bench = _bench(rng, centred=centred)
    train = _run_plan(rng, bench, 1.0, centred=centred)
    return bench, train, _nominal(bench, train)


def _dyno(rng: Rng, *, centred: bool) -> tuple[Bench, RunPlan, Nominal]:
    bench = dyno.draw_bench(rng)
    train = dyno.draw_run(rng, bench, centred=centred)
    return bench, train, dyno.nominal_of(bench, train)


def _sensors(rng: Rng, recipe: _Recipe, effects: tuple[Planted, ...]) -> Sensors:
    usual = _usual_sensors(rng, recipe, effects)
    if recipe.base != "disturbed":
        return usual
    noise_time_s, late_s = 10.0 ** rng.uniform(-3.3, -2.0), rng.uniform(1e-4, 5e-3)
    return replace(usual, noise_time_s=float(noise_time_s), late_s=float(late_s))


def _usual_sensors(rng: Rng, recipe: _Recipe, effects: tuple[Planted, ...]) -> Sensors:
    warms = any(e.law == "thin_oil" for e in effects)
    if recipe.is_dyno:
        return dyno.draw_sensors(rng, has_temperature=warms or rng.random() < 0.1)
    return Sensors(
        sample_rate_hz=1000 if rng.random() < 0.75 else 500,
        height_noise_m=float(10.0 ** rng.uniform(-6.0, -4.0)),
        has_temperature=warms or rng.random() < 0.1,
    )


def _roughness(rng: Rng, recipe: _Recipe, nominal: Nominal) -> Roughness:
    """As a careful guess from a data sheet; on a dyno no mass and no load is in play."""
    if not recipe.is_rough:
        return Roughness()
    stiffness, damping = float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.4, 0.4))
    share = float(rng.uniform(-0.05, 0.05))
    if recipe.is_dyno:
        return Roughness(stiffness=stiffness, damping=damping, preload_n=share * nominal.load_rms_n)
    gain = float(rng.uniform(-0.02, 0.02)) if rng.random() < GAIN_ERROR_SHARE else 0.0
    mass = float(rng.uniform(-0.05, 0.05))
    return Roughness(mass, stiffness, damping, share * nominal.bench.weight_n, gain)


def _families(rng: Rng, seed: int, recipe: _Recipe) -> tuple[str, ...]:
    kind, families = recipe.base, recipe.families
    if kind in families:
        return (kind,)
    if kind == "single":
        return (families[seed % len(families)],)
    if kind in FOREIGN_KINDS:
        return (FOREIGN_KINDS[kind],)
    if kind in {"pair", "triple"}:
        count = 2 if kind == "pair" else 3
        return tuple(str(f) for f in rng.choice(families, count, replace=False))
    fixed = {
        "complete": (),
        "disturbed": (),
        "outside": ("outside",),
        "friction_and_cubic": ("friction", "nonlinear_stiffness"),
    }
    if kind not in fixed:
        expected = ", ".join([*KINDS, *families])
        raise ValueError(f"kind {kind!r}: expected one of {expected}, or rough_ or dyno_ before it")
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


def _coarse(effects: tuple[Planted, ...]) -> tuple[Planted, ...]:
    """The effects as coarse steps can follow them."""
    return tuple(_dry(effect) if effect.law == "bristle" else effect for effect in effects)


def _coarse_motion(bench: Bench, effects: tuple[Planted, ...], plan: RunPlan) -> Motion:
    """The run in coarse steps, to plan with; stiff bristles are replaced by dry contact."""
    steps = (5000 if effects else 2500) // PLANNING_RATE_HZ
    return true_motion(bench, _coarse(effects), plan, PLANNING_RATE_HZ, steps)[1]


def _swing(bench: Bench, excitation: Excitation) -> float:
    """Half the stroke of the bench without effects."""
    motion = _coarse_motion(bench, (), RunPlan(excitation, 0.0, START_C, 0))
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
    motion = _coarse_motion(bench, (), plan)
    return Nominal(
        bench,
        plan.excitation,
        motion.height_m - bench.free_length_m,
        motion.velocity_m_per_s,
        motion.acceleration_m_per_s2,
        plan.excitation.amplitude_n,
    )


def _refuse_unfit(case: Case, plan: RunPlan) -> None:
    if case.is_dyno:
        if not dyno.is_fit(case.bench, _coarse(case.effects), plan):
            raise _UnfitError
        return
    motion = _coarse_motion(case.bench, case.effects, plan)
    z = motion.height_m
    if not np.all(np.isfinite(z)) or z.min() < HEIGHT_LOW_M or z.max() > HEIGHT_HIGH_M:
        raise _UnfitError
    # A body that friction holds fast, or a gas column at its end, tells nothing.
    settled = z[z.size // 10 :]
    if np.std(settled) < LEAST_SWING_M / 2.0 or np.abs(motion.force_n).max(initial=0.0) > 5e3:
        raise _UnfitError
