"""From the bench's configuration to its equations of motion and its state at the start."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import interpolate, optimize

from rig.simulated_bench.compilation import Floats
from rig.simulated_bench.curves import Curves
from rig.simulated_bench.drive import (
    SINE_COLUMNS,
    SWEEP_COLUMNS,
    BenchDrive,
    DrivenForce,
    DrivenHeight,
)
from rig.simulated_bench.effects import EFFECT_KINDS, PARAMETER_COUNT, parameter_values
from rig.simulated_bench.equations_of_motion import (
    INPUTS,
    BenchMechanics,
    Effects,
    Thermal,
    derivatives,
    write_inputs,
)
from rig.simulated_bench.laws import LawCode
from rig.simulated_bench.schema import (
    WORLD,
    AppliedForce,
    BenchConfig,
    BenchConfigError,
    Component,
    DamperCurve,
    ForceFile,
    HeightComponent,
    HeightFile,
    HeightMultisine,
    HeightSine,
    HeightSweep,
    Multisine,
    Sine,
    SpringCurve,
    StrutMotion,
    Sweep,
    UndeclaredEffect,
)

EQUILIBRIUM_TOLERANCE_M_PER_S2 = 1e-9
"""Largest acceleration that counts as rest."""


class Assembly(NamedTuple):
    """A bench ready to run, with its state at time zero, shape (states,)."""

    mechanics: BenchMechanics
    drive: BenchDrive
    start: Floats


def assemble(config: BenchConfig) -> Assembly:
    """Build the equations of motion and the state at the start.

    Raises:
        BenchConfigError: It has no static equilibrium to start from, or an effect leaves a body no
            mass.
    """
    mechanics = _mechanics(config)
    drive = BenchDrive(
        _force_arrays(config.applied_force, config.undeclared_effects),
        _height_arrays(config.prescribed_motion),
    )
    return Assembly(mechanics, drive, _start(config, mechanics, drive))


def _mechanics(config: BenchConfig) -> BenchMechanics:
    uppers = [strut.between[1] for strut in config.struts]
    lowers = [strut.between[0] for strut in config.struts]
    thermal, motion = config.temperature, config.prescribed_motion
    return BenchMechanics(
        gravity_m_per_s2=config.gravity_m_per_s2,
        mass_kg=_masses(config, uppers),
        lower=np.array([-1 if name == WORLD else uppers.index(name) for name in lowers]),
        driven=uppers.index(config.applied_force.body or uppers[0]),
        prescribed=-1 if motion is None else _strut_index(config, motion.strut),
        free_length_m=np.array([strut.free_length_m for strut in config.struts]),
        springs=_curves([_by_points(strut.spring) for strut in config.struts]),
        dampers=_curves([_by_points(strut.damper) for strut in config.struts]),
        effects=_effects(config),
        thermal=Thermal(
            warming_k_per_j=1.0 / (thermal.heat_capacity_j_per_k or math.inf),
            cooling_per_s=1.0 / (thermal.cooling_time_s or math.inf),
            ambient_c=thermal.ambient_c,
        ),
    )


def _masses(config: BenchConfig, uppers: list[str]) -> Floats:
    by_name = {mass.name: mass.mass_kg for mass in config.masses}
    mass_kg = np.array([by_name[name] for name in uppers], dtype=np.float64)
    for index, effect in enumerate(config.undeclared_effects):
        if EFFECT_KINDS[effect.name].law == LawCode.ADDED_MASS:
            body = _strut_index(config, effect.strut)
            mass_kg[body] += parameter_values(effect.name, effect.parameters)[0]
            if mass_kg[body] <= 0.0:
                raise BenchConfigError(
                    f"undeclared_effects.{index}.parameters.mass_kg leaves {uppers[body]} "
                    f"{mass_kg[body]:g} kg, expected more than 0"
                )
    return mass_kg


def _strut_index(config: BenchConfig, name: str) -> int:
    return [strut.name for strut in config.struts].index(name)


def _curves(segments: Sequence[Floats]) -> Curves:
    """Curves by the segments of each, shape (segments, 6)."""
    return Curves(
        first=np.cumsum([0, *(len(part) for part in segments)]),
        segments=np.concatenate([np.empty((0, 6)), *segments]),
    )


def _by_points(curve: SpringCurve | DamperCurve) -> Floats:
    """Segments of a curve through points without overshoot, shape (segments, 6)."""
    at, force_n = (np.array(points) for _, points in curve)
    return _segments(at, interpolate.PchipInterpolator(at, force_n))


def _segments(at: Floats, cubics: interpolate.PPoly) -> Floats:
    return np.column_stack([at[:-1], np.diff(at), np.asarray(cubics.c, dtype=np.float64).T])


def _force_arrays(force: AppliedForce, effects: tuple[UndeclaredEffect, ...]) -> DrivenForce:
    sines, sweeps = _sines_and_sweeps(force.components)
    files = [part.samples for part in force.components if isinstance(part, ForceFile)]
    return DrivenForce(
        gain=math.prod(_values(effects, LawCode.INPUT_GAIN)),
        delay_s=math.fsum(_values(effects, LawCode.DELAY)),
        sines=sines,
        sweeps=sweeps,
        file_first=np.cumsum([0, *(len(samples.t_s) for samples in files)]),
        file_t_s=np.concatenate([np.empty(0), *(samples.t_s for samples in files)]),
        file_force_n=np.concatenate([np.empty(0), *(samples.values for samples in files)]),
    )


def _height_arrays(motion: StrutMotion | None) -> DrivenHeight:
    components = () if motion is None else motion.components
    sines, sweeps = _sines_and_sweeps(components)
    files = [part.samples for part in components if isinstance(part, HeightFile)]
    return DrivenHeight(
        mean_height_m=0.0 if motion is None else motion.mean_height_m,
        sines=sines,
        sweeps=sweeps,
        files=_curves(
            [_segments(t_s, interpolate.CubicSpline(t_s, height_m)) for t_s, height_m in files]
        ),
    )


def _sines_and_sweeps(parts: Sequence[Component | HeightComponent]) -> tuple[Floats, Floats]:
    """Rows of `SINE_COLUMNS` and of `SWEEP_COLUMNS`."""
    sines: list[tuple[float, ...]] = []
    sweeps: list[tuple[float, ...]] = []
    for part in parts:
        match part:
            case Sine(amplitude_n=amplitude) | HeightSine(amplitude_m=amplitude):
                sines.append((amplitude, part.rate_rad_per_s, part.phase_rad))
            case Multisine(rms_n=rms) | HeightMultisine(rms_m=rms):
                sines.extend(_multisine(part, rms))
            case Sweep(amplitude_n=amplitude) | HeightSweep(amplitude_m=amplitude):
                logarithmic = float(part.spacing == "logarithmic")
                row = amplitude, part.start_hz, part.end_hz, part.duration_s, logarithmic
                sweeps.append(row)
            case ForceFile() | HeightFile():
                pass
    return (
        np.array(sines, dtype=np.float64).reshape(-1, SINE_COLUMNS),
        np.array(sweeps, dtype=np.float64).reshape(-1, SWEEP_COLUMNS),
    )


def _multisine(part: Multisine | HeightMultisine, rms: float) -> list[tuple[float, ...]]:
    rates = 2.0 * math.pi * np.linspace(part.low_hz, part.high_hz, part.lines)
    phases = np.random.default_rng(part.seed).uniform(0.0, 2.0 * math.pi, part.lines)
    amplitude = rms * math.sqrt(2.0 / part.lines)
    return [
        (amplitude, float(rate), float(phase)) for rate, phase in zip(rates, phases, strict=True)
    ]


def _values(effects: tuple[UndeclaredEffect, ...], law: LawCode) -> list[float]:
    return [
        parameter_values(effect.name, effect.parameters)[0]
        for effect in effects
        if EFFECT_KINDS[effect.name].law == law
    ]


def _effects(config: BenchConfig) -> Effects:
    acting = config.undeclared_effects
    kinds = [EFFECT_KINDS[effect.name] for effect in acting]
    parameters = np.zeros((len(acting), PARAMETER_COUNT))
    for row, effect in zip(parameters, acting, strict=True):
        values = parameter_values(effect.name, effect.parameters)
        row[: len(values)] = values
    first_state = 2 * len(config.struts) + 1
    states = np.cumsum([first_state, *(kind.states for kind in kinds)])
    struts = [_strut_index(config, effect.strut) for effect in acting]
    indices = [[int(kind.law) for kind in kinds], struts, states[:-1]]
    return Effects(np.array(indices, dtype=np.int64).T.copy(), parameters)


def _start(config: BenchConfig, mechanics: BenchMechanics, drive: BenchDrive) -> Floats:
    n = len(config.struts)
    states = 2 * n + 1 + sum(EFFECT_KINDS[e.name].states for e in config.undeclared_effects)
    y = np.zeros(states)
    y[2 * n] = config.temperature.initial_c
    for (law, _, state), values in zip(*mechanics.effects, strict=True):
        if law == LawCode.HIDDEN_MASS:
            mass_kg, stiffness_n_per_m = values[0], values[1]
            y[state] = -mass_kg * mechanics.gravity_m_per_s2 / stiffness_n_per_m
    heights_m = [strut.initial_height_m for strut in config.struts]
    at_start = np.zeros(INPUTS)
    if mechanics.prescribed >= 0:
        write_inputs(mechanics, drive, 0.0, at_start)
        heights_m[mechanics.prescribed] = float(at_start[1])
    at_start[[0, 2]] = 0.0  # the others rest before it starts
    y[:n] = _positions(mechanics, _heights(mechanics, y, heights_m, at_start))
    return y


def _positions(mechanics: BenchMechanics, heights_m: Floats) -> Floats:
    positions_m = np.array(heights_m, dtype=np.float64)
    for i, lower in enumerate(mechanics.lower):
        if lower >= 0:
            positions_m[i] += positions_m[lower]
    return positions_m


def _heights(
    mechanics: BenchMechanics, y: Floats, given: Sequence[float | None], at_start: Floats
) -> Floats:
    """Heights at the start: those inputs, and those at which the other bodies rest, shape (n,)."""
    n = len(given)
    free = [i for i in range(n) if given[i] is None]
    heights_m = np.array(
        [
            length if h is None else h
            for h, length in zip(given, mechanics.free_length_m, strict=True)
        ]
    )
    if not free:
        return heights_m
    rates = np.zeros_like(y)

    def accelerations(unknown: Floats) -> Floats:
        heights_m[free] = unknown
        state = y.copy()
        state[:n] = _positions(mechanics, heights_m)
        derivatives(mechanics, 0.0, at_start, state, rates)
        return rates[n : 2 * n][free]

    solution = optimize.root(accelerations, heights_m[free].copy(), tol=1e-13)
    resting_m = np.asarray(solution.x, dtype=np.float64)
    residual_m_per_s2 = float(np.max(np.abs(accelerations(resting_m))))
    if not residual_m_per_s2 <= EQUILIBRIUM_TOLERANCE_M_PER_S2:
        raise BenchConfigError(
            f"struts.{free[0]}.initial_height_m is missing and there is no static equilibrium "
            "to start from, expected a height"
        )
    heights_m[free] = resting_m
    return heights_m
