"""A corrected model at a run's rate: it follows the recording that was not learnt from."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from can_dbc.errors import InputError
from dart_model.plant import DartPlant
from dart_model.spec import ModelSpec
from rig.bridge.mode_supervisor import Supervisor
from rig.bridge.values import StepInput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE, TEMPERATURE
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.poles import OperatingPoint
from rig.closed_loop.strut_response import FAST_SPEED_M_PER_S, linearise_at
from rig.recordings.recording import Recording
from rig.tuning.expectation import expectation_from_noise
from rig.tuning.gains import Aim, TuningProblem, tune_observer
from tests.bridge.cores import GAINS, SUPERVISION, bench_sample, channels, supervised

LIMIT_N = 5000.0
UP_TO_HZ = 20.0
"""Frequency up to which a model's remaining force is expected."""
USUAL = 1.5
"""Times the expected force up to which nothing but noise is needed to explain it."""
SETTLED = 0.5
"""Share of the recording from which on the force counts."""


def live_force(
    spec: ModelSpec, recording: Recording, noise_m: float, residual_n: float, late_s: float = 0.0
) -> float:
    """RMS residual force that an observer finds of a right model of one strut, over its floor.

    The model follows the recording tick by tick, with tuned gains. The floor is what the model
    leaves, what is lost by holding the applied force, and what the noise of the height makes of
    the gains. That is expected of a model in motion: where more is found, the last two are what
    the same observer finds of a bench that is the model itself, with noise like the sensor's, for
    friction at rest makes a force of the height's noise as a stiff spring does. Infinite where no
    gains make the loop stable, or a force is not finite.

    Args:
        noise_m: Standard deviation of the height's noise.
        residual_n: RMS of the force that the model leaves.
        late_s: By how much later than the applied force the height shows what is true.
    """
    plant = DartPlant(spec)
    period_ns = round(1e9 * float(np.median(np.diff(recording.t_s))))
    late_ns = round(1e9 * late_s)
    expected_n = math.hypot(residual_n, _lost_by_holding_n(recording))
    rest_m = [float(np.nanmean(recording.heights_m[:, 0]))]
    problem = TuningProblem(
        plant,
        (GAINS,),
        0,
        linearise_at(plant, rest_m),
        rest_m,
        SampleTiming.of(period_ns, period_ns, late_ns),
        expectation_from_noise(noise_m, expected_n, UP_TO_HZ),
        LIMIT_N,
        [OperatingPoint(rest_m, FAST_SPEED_M_PER_S)],
    )
    try:
        tuned = tune_observer(problem, "kalman", Aim())
    except InputError:
        return math.inf
    if tuned.gain_margin <= 1.0 or tuned.in_motion <= 0.0:
        return math.inf
    bench = channels(1, interval_ns=period_ns, delay_ns=late_ns)
    stale_after_s = SUPERVISION.stale_after_s + late_s
    supervision = SUPERVISION.model_copy(update={"stale_after_s": stale_after_s})
    rig = supervised(plant, (tuned.observer,), supervision, bench=bench)
    found_n = _force_found_n(rig, _inputs(recording, period_ns, late_ns))
    floor_n = math.hypot(expected_n, tuned.expected.noise_n)
    if floor_n * USUAL < found_n < math.inf:
        itself = _as_bench(plant, recording, noise_m, late_ns // period_ns)
        of_itself_n = _force_found_n(rig, _inputs(itself, period_ns, late_ns))
        floor_n = max(floor_n, math.hypot(residual_n, of_itself_n))
    return found_n / floor_n


def _force_found_n(rig: Supervisor, inputs: Iterator[StepInput]) -> float:
    """RMS residual force that an observer finds once it has settled; infinite if not finite."""
    state, found_n = rig.init(0), list[float]()
    for step_input in inputs:
        state, output, _ = rig.step(state, step_input)
        found_n += [strut.force_n - strut.law_force_n for strut in output.struts]
    if not found_n or not np.all(np.isfinite(found_n)):
        return math.inf
    late_n = np.array(found_n)[round(SETTLED * len(found_n)) :]
    return float(np.sqrt(np.mean(late_n**2)))


def _as_bench(plant: DartPlant, recording: Recording, noise_m: float, late_ticks: int) -> Recording:
    """A recording of the bench that a model is, under the forces of another, with drawn noise."""
    dt_s = float(np.median(np.diff(recording.t_s)))
    count, nothing = len(recording.t_s), np.zeros(len(recording.t_s))
    force_n, temperature_c = (
        nothing if values is None else np.nan_to_num(values)
        for values in (recording.applied_force_n, recording.temperature_c)
    )
    forces = force_n[:, np.newaxis].tolist() if plant.inputs else [()] * count
    state = plant.init([float(np.nanmean(recording.heights_m[:, 0]))])
    heights_m = [state.struts[0][0]]
    for before, after, warm_c in zip(forces, forces[1:], temperature_c.tolist(), strict=False):
        loaded = plant.load(state, [0.0], before, warm_c)
        state = plant.step(loaded, dt_s, after)
        heights_m.append(state.struts[0][0])
    noise = noise_m * np.random.default_rng(0).standard_normal(count)
    seen_m = np.concatenate([np.full(late_ticks, heights_m[0]), heights_m])[:count] + noise
    return replace(recording, heights_m=seen_m[:, np.newaxis])


def _lost_by_holding_n(recording: Recording) -> float:
    """RMS of what a force that is held from tick to tick differs by from that of the bench.

    It acts half a tick late.
    """
    force_n = recording.applied_force_n
    return 0.0 if force_n is None else float(np.sqrt(np.nanmean((0.5 * np.diff(force_n)) ** 2)))


def _inputs(recording: Recording, period_ns: int, late_ns: int) -> Iterator[StepInput]:
    further = ((APPLIED_FORCE, recording.applied_force_n), (TEMPERATURE, recording.temperature_c))
    for tick, height_m in enumerate(recording.heights_m[:, 0].tolist()):
        t_ns = tick * period_ns
        samples = [] if math.isnan(height_m) else [Sample(0, height_m, t_ns - late_ns)]
        samples += [
            bench_sample(1, quantity, float(values[tick]), t_ns)
            for quantity, values in further
            if values is not None and math.isfinite(values[tick])
        ]
        yield StepInput(t_ns, tuple(samples))
