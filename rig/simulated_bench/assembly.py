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
    DrivenHeights,
)
from rig.simulated_bench.effects import EFFECT_KINDS, PARAMETER_COUNT, parameter_values
from rig.simulated_bench.equations_of_motion import (
    BenchMechanics,
    Effects,
    Ends,
    RigidBodies,
    Thermal,
    derivatives,
    write_inputs,
)
from rig.simulated_bench.laws import LawCode
from rig.simulated_bench.schema import (
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
    thermal, firsts = config.temperature, _first_positions(config)
    rigid = {it.name: it.moments_kg_m2 for it in config.masses if it.moments_kg_m2 is not None}
    ends = [[firsts.get(name, -1) for name in strut.between] for strut in config.struts]
    inertia, is_height = _inertia(config, firsts)
    return BenchMechanics(
        gravity_m_per_s2=config.gravity_m_per_s2,
        inertia=inertia,
        is_height=is_height,
        rigid=RigidBodies(
            first=np.array([firsts[name] for name in rigid], dtype=np.int64),
            more_kg_m2=np.array([z - y for _, y, z in rigid.values()], dtype=np.float64),
        ),
        ends=Ends(
            size=len(inertia),
            positions=np.array(ends),
            is_rigid=np.array(
                [[name in rigid for name in strut.between] for strut in config.struts],
                dtype=np.int64,
            ),
            places_m=_places(config, set(rigid)),
        ),
        driven=firsts[config.applied_force.body or config.struts[0].between[1]],
        prescribed=np.array(
            [_strut_index(config, motion.strut) for motion in config.prescribed_motion],
            dtype=np.int64,
        ),
        free_length_m=np.array([strut.free_length_m for strut in config.struts]),
        springs=_curves([_by_points(strut.spring) for strut in config.struts]),
        dampers=_curves([_by_points(strut.damper) for strut in config.struts]),
        effects=_effects(config, len(inertia)),
        thermal=Thermal(
            warming_k_per_j=1.0 / (thermal.heat_capacity_j_per_k or math.inf),
            cooling_per_s=1.0 / (thermal.cooling_time_s or math.inf),
            ambient_c=thermal.ambient_c,
        ),
    )


def _first_positions(config: BenchConfig) -> dict[str, int]:
    """Index of each body's first position, in the order in which struts carry them."""
    masses = {mass.name: mass for mass in config.masses}
    firsts: dict[str, int] = {}
    n = 0
    for strut in config.struts:
        upper = strut.between[1]
        if upper not in firsts:
            firsts[upper] = n
            n += 1 if masses[upper].moments_kg_m2 is None else 3
    return firsts


def _inertia(config: BenchConfig, firsts: dict[str, int]) -> tuple[Floats, Floats]:
    """Mass or moment of inertia of each position, and 1 where it is a height."""
    added = _added_masses(config)
    masses = {mass.name: mass for mass in config.masses}
    inertia: list[float] = []
    is_height: list[float] = []
    for name in firsts:
        inertia.append(masses[name].mass_kg + added.get(name, 0.0))
        is_height.append(1.0)
        if (moments := masses[name].moments_kg_m2) is not None:
            about_x, about_y, _ = moments
            inertia += [about_y, about_x]
            is_height += [0.0, 0.0]
    return np.array(inertia), np.array(is_height)


def _added_masses(config: BenchConfig) -> dict[str, float]:
    """Mass in kg that undeclared effects add to bodies, by their names."""
    masses = {mass.name: mass for mass in config.masses}
    added: dict[str, float] = {}
    for index, effect in enumerate(config.undeclared_effects):
        if EFFECT_KINDS[effect.name].law == LawCode.ADDED_MASS:
            where = f"undeclared_effects.{index}"
            body = masses[config.struts[_strut_index(config, effect.strut)].between[1]]
            if body.moments_kg_m2 is not None:
                raise BenchConfigError(
                    f"{where}: {effect.name} on the rigid body {body.name}, whose moments of "
                    "inertia would change too, expected another effect"
                )
            more_kg = parameter_values(effect.name, effect.parameters)[0]
            added[body.name] = added.get(body.name, 0.0) + more_kg
            if (mass_kg := body.mass_kg + added[body.name]) <= 0.0:
                raise BenchConfigError(
                    f"{where}.parameters.mass_kg leaves {body.name} {mass_kg:g} kg, expected more "
                    "than 0"
                )
    return added


def _places(config: BenchConfig, rigid: set[str]) -> Floats:
    """Where on rigid bodies the ends of struts are, shape (struts, 2, 2)."""
    places = np.zeros((len(config.struts), 2, 2))
    for place, strut in zip(places, config.struts, strict=True):
        for end, name in enumerate(strut.between):
            if name in rigid and strut.place_m is not None:
                place[end] = strut.place_m
    return places


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


def _height_arrays(motions: Sequence[StrutMotion]) -> DrivenHeights:
    parts = [_sines_and_sweeps(motion.components) for motion in motions]
    files = [
        [part.samples for part in motion.components if isinstance(part, HeightFile)]
        for motion in motions
    ]
    counts = [
        [len(sines) for sines, _ in parts],
        [len(sweeps) for _, sweeps in parts],
        [len(each) for each in files],
    ]
    return DrivenHeights(
        mean_height_m=np.array([motion.mean_height_m for motion in motions], dtype=np.float64),
        firsts=np.array([np.cumsum([0, *each]) for each in counts]),
        sines=np.concatenate([np.empty((0, SINE_COLUMNS)), *(sines for sines, _ in parts)]),
        sweeps=np.concatenate([np.empty((0, SWEEP_COLUMNS)), *(sweeps for _, sweeps in parts)]),
        files=_curves(
            [
                _segments(t_s, interpolate.CubicSpline(t_s, height_m))
                for each in files
                for t_s, height_m in each
            ]
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


def _effects(config: BenchConfig, positions: int) -> Effects:
    acting = config.undeclared_effects
    kinds = [EFFECT_KINDS[effect.name] for effect in acting]
    parameters = np.zeros((len(acting), PARAMETER_COUNT))
    for row, effect in zip(parameters, acting, strict=True):
        values = parameter_values(effect.name, effect.parameters)
        row[: len(values)] = values
    first_state = 2 * positions + 1
    states = np.cumsum([first_state, *(kind.states for kind in kinds)])
    struts = [_strut_index(config, effect.strut) for effect in acting]
    indices = [[int(kind.law) for kind in kinds], struts, states[:-1]]
    return Effects(np.array(indices, dtype=np.int64).T.copy(), parameters)


def _start(config: BenchConfig, mechanics: BenchMechanics, drive: BenchDrive) -> Floats:
    n = len(mechanics.inertia)
    states = 2 * n + 1 + sum(EFFECT_KINDS[e.name].states for e in config.undeclared_effects)
    y = np.zeros(states)
    y[2 * n] = config.temperature.initial_c
    for (law, _, state), values in zip(*mechanics.effects, strict=True):
        if law == LawCode.HIDDEN_MASS:
            mass_kg, stiffness_n_per_m = values[0], values[1]
            y[state] = -mass_kg * mechanics.gravity_m_per_s2 / stiffness_n_per_m
    heights_m = [strut.initial_height_m for strut in config.struts]
    at_start = np.zeros(1 + 2 * len(mechanics.prescribed))
    write_inputs(mechanics, drive, 0.0, at_start)
    for i, strut in enumerate(mechanics.prescribed.tolist()):
        heights_m[strut] = float(at_start[1 + 2 * i])
    at_start[[0, *range(2, len(at_start), 2)]] = 0.0  # the others rest before it starts
    y[:n] = _rest(mechanics, y, heights_m, at_start)
    return y


def _rest(
    mechanics: BenchMechanics, y: Floats, given: Sequence[float | None], at_start: Floats
) -> Floats:
    """Positions at the start: of given heights, and where the other bodies rest, shape (n,).

    Unknown are the height of the first strut below each of these, and a rigid body's angles.
    """
    n = len(mechanics.inertia)
    first_struts = _first_struts(mechanics)
    lengths = [
        length if h is None else h for h, length in zip(given, mechanics.free_length_m, strict=True)
    ]
    unknown = np.zeros(n)
    unknown[list(first_struts)] = [lengths[strut] for strut in first_struts.values()]
    free = [i for i in range(n) if i not in first_struts or given[first_struts[i]] is None]
    if not free:
        return _positions(mechanics, first_struts, unknown)
    rates = np.zeros_like(y)

    def accelerations(found: Floats) -> Floats:
        unknown[free] = found
        state = y.copy()
        state[:n] = _positions(mechanics, first_struts, unknown)
        derivatives(mechanics, 0.0, at_start, state, rates)
        return rates[n : 2 * n][free]

    solution = optimize.root(accelerations, unknown[free].copy(), tol=1e-13)
    resting = np.asarray(solution.x, dtype=np.float64)
    residual_m_per_s2 = float(np.max(np.abs(accelerations(resting))))
    if not residual_m_per_s2 <= EQUILIBRIUM_TOLERANCE_M_PER_S2:
        strut = min(first_struts[i] for i in free if i in first_struts)
        raise BenchConfigError(
            f"struts.{strut}.initial_height_m is missing and there is no static equilibrium "
            "to start from, expected a height"
        )
    unknown[free] = resting
    return _positions(mechanics, first_struts, unknown)


def _first_struts(mechanics: BenchMechanics) -> dict[int, int]:
    """The first strut below each body, by the body's first position."""
    first: dict[int, int] = {}
    for strut, (_, upper) in enumerate(mechanics.ends.positions.tolist()):
        first.setdefault(upper, strut)
    return first


def _positions(mechanics: BenchMechanics, first_struts: dict[int, int], above: Floats) -> Floats:
    """Positions of bodies, each with its height above that which its first strut stands on."""
    positions = np.array(above, dtype=np.float64)
    for position, strut in first_struts.items():
        lower = mechanics.ends.positions[strut, 0]
        if lower >= 0:
            positions[position] += positions[lower]
    return positions
