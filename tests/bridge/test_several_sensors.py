"""Several sensors of one strut in one filter: against theory, late ones, and ones that fail."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import Mode, StepInput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import APPLIED_FORCE, FORCE, HEIGHT, VELOCITY
from rig.observers.error_filter import ErrorFilter
from rig.observers.error_model import ErrorModel
from rig.observers.kalman import KalmanObserver
from rig.observers.protocol import Innovation, Start
from rig.observers.strut_observers import ObserversState, StrutObservers
from tests.bridge.cores import MS, bench_sample, channels, measured, supervised
from tests.observers.benches import Truth

NOISE_M, BANDWIDTH_HZ = 2e-5, 20.0
FIRST = 4
"""Index of the first further sensor: one height and three quantities of the bench are before it."""


def sensor(name, quantity, noise_std, interval_ns, delay_ns=0):
    key = f"signals.further.{name}"
    return Channel(
        FIRST, Role.SENSOR, quantity, name, key, 0, interval_ns, delay_ns, noise_std=noise_std
    )


SECOND_HEIGHT = sensor("strut.wire", HEIGHT, NOISE_M, MS)


def kalman(bandwidth_hz=BANDWIDTH_HZ, noise_std_m=NOISE_M):
    return KalmanObserver("kalman", ErrorFilter(bandwidth_hz, noise_std_m))


MODEL = ErrorModel(
    np.zeros((1, 2)), np.array([[-400.0, -20.0]]), np.array([[0.1]]), np.array([[1.0]])
)
"""A mass of 10 kg on a spring of 400 N/m with a damper of 20 N·s/m."""


class Alone:
    """The observers of this strut; no model answers to the virtual force."""

    def __init__(self, observer, *sensors):
        self._observers = StrutObservers([observer])
        start = Start(0, 0.1, MS, 0, 40.0, 2.0, sensors)
        self.state = self._observers.init([start], MODEL, ObserversState())

    def step(self, t_ns, height_m, further=()):
        self.state = self._observers.step(self.state, t_ns, [Innovation(height_m, t_ns)], [further])
        joint = self.state.joint
        still = tuple((since_ns, np.zeros(1)) for since_ns, _ in joint.inputs)
        self.state = replace(self.state, joint=replace(joint, inputs=still))
        return self.state.struts[0]


NEVER = sensor("strut.never", FORCE, 1.0, MS)


def test_two_equal_sensors_are_one_of_half_the_variance():
    # The intensity of the force's noise is omega^10 sigma^2 h: the same with both.
    both = Alone(kalman(), SECOND_HEIGHT)
    one = Alone(kalman(BANDWIDTH_HZ * 2.0**0.1, NOISE_M / np.sqrt(2.0)), NEVER)
    rng = np.random.default_rng(1)
    for tick in range(1, 2001):
        t_ns, (a, b) = tick * MS, NOISE_M * rng.standard_normal(2)
        fusing = both.step(t_ns, a, [Innovation(b, t_ns, FIRST)])
        alone = one.step(t_ns, (a + b) / 2.0)
        if tick > 1000:  # the scales of the variances follow other innovations
            assert fusing.residual_force_n == pytest.approx(
                alone.residual_force_n, rel=0.01, abs=0.02
            )
    own, own_alone = (np.sqrt(it.state.joint.references[0].scale) for it in (both, one))
    # Each lag is another one, of innovations that are not the same.
    assert fusing.force_std_n / own == pytest.approx(alone.force_std_n / own_alone, rel=0.1)


@settings(max_examples=30)
@given(
    late=st.lists(st.sampled_from([0, 2, 5]), min_size=30, max_size=30),
    seed=st.integers(0, 1000),
)
def test_a_late_reading_is_used_at_its_time(late, seed):
    """Whatever comes late: in the end the filter is the one that had all in order."""
    rng = np.random.default_rng(seed)
    delayed = sensor("strut.wire", VELOCITY, 1e-3, MS, 5 * MS)
    readings = [(tick * MS + MS // 2, 1e-4 * rng.standard_normal()) for tick in range(30)]
    heights = NOISE_M * rng.standard_normal(40)
    found = []
    for delays in ([0] * 30, late):
        bench = Alone(kalman(), delayed)
        for tick in range(1, 40):
            t_ns = tick * MS
            here = [
                Innovation(value, at_ns, FIRST)
                for (at_ns, value), delay in zip(readings, delays, strict=True)
                if t_ns - MS < at_ns + delay * MS <= t_ns
            ]
            bench.step(t_ns, heights[tick], here)
        found.append(bench.state.joint.point)
    assert np.allclose(found[0].mean, found[1].mean, rtol=1e-9, atol=1e-12)
    assert np.allclose(found[0].covariance, found[1].covariance, rtol=1e-9)


TRUTH = Truth(10.0, 2.0, 1000, 4.0)
SUPERVISION = Supervision(stale_after_s=0.03, safe_after_s=0.5)


def velocity():
    return np.gradient(TRUTH.height_m, 1e-3)


def follow(sensors, readings, *, heights=None, observer=None):
    """Outputs of the bench of 10 kg; `readings` of a tick: place and value, now."""
    seen = TRUTH.height_m if heights is None else heights
    core = supervised(
        TRUTH.plant,
        (observer or kalman(25.0, NOISE_M),),
        SUPERVISION,
        channels(1, sensors=sensors),
    )
    state, outputs = core.init(0), []
    for tick, (height_m, applied_n) in enumerate(zip(seen, TRUTH.applied_n, strict=True)):
        t_ns = tick * MS
        samples = [] if np.isnan(height_m) else [Sample(0, float(height_m), t_ns)]
        samples += [
            Sample(FIRST + index, value, t_ns - sensors[index].delay_ns)
            for index, value in readings(tick)
            if value is not None
        ]
        samples.append(bench_sample(1, APPLIED_FORCE, float(applied_n), t_ns))
        state, output, _ = core.step(state, StepInput(t_ns, tuple(samples)))
        outputs.append(output)
    return outputs


def noisy(values, std, seed):
    return values + std * np.random.default_rng(seed).standard_normal(len(values))


def errors(outputs, first=500):
    found = np.array(
        [
            [item.force_n, item.force_std_n]
            for (item,) in (output.struts for output in outputs[first:])
        ]
    )
    return found[:, 0] - TRUTH.force_n[first : first + len(found)], found[:, 1]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


CELL = sensor("strut.cell", FORCE, 0.5, MS)
TACHO = sensor("strut.tacho", VELOCITY, 1e-3, MS)
WIRE = sensor("strut.wire", HEIGHT, 1e-5, 5 * MS)


@pytest.mark.parametrize(("channel", "share"), [(CELL, 0.4), (TACHO, 0.85), (WIRE, 1.0)])
def test_a_further_sensor_makes_the_force_better_and_its_interval_honest(channel, share):
    heights = noisy(TRUTH.height_m, NOISE_M, 1)
    values = {
        FORCE: TRUTH.force_n,
        VELOCITY: velocity(),
        HEIGHT: TRUTH.height_m,
    }[channel.quantity]
    read = noisy(values, channel.noise_std, 2)
    every = channel.interval_ns // MS
    alone, _ = errors(follow((), lambda _tick: [], heights=heights))
    outputs = follow(
        (channel,), lambda tick: [(0, read[tick])] if tick % every == 0 else [], heights=heights
    )
    missed, std_n = errors(outputs)
    assert rms(missed) < share * rms(alone)
    assert 0.93 <= np.mean(np.abs(missed) < 1.96 * std_n) <= 0.995
    assert not any(output.left_out for output in outputs)


@pytest.mark.slow
@pytest.mark.parametrize("channel", [CELL, TACHO])
def test_a_late_sensor_is_held_against_the_model_of_its_time(channel):
    late = sensor(channel.name, channel.quantity, channel.noise_std, MS, 5 * MS)
    values = TRUTH.force_n if channel is CELL else velocity()
    heights, read = noisy(TRUTH.height_m, NOISE_M, 1), noisy(values, channel.noise_std, 2)
    at_once, _ = errors(follow((channel,), lambda tick: [(0, read[tick])], heights=heights))
    delayed, _ = errors(
        follow((late,), lambda tick: [(0, read[tick - 5])] if tick >= 5 else [], heights=heights)
    )
    ignored, _ = errors(
        follow((channel,), lambda tick: [(0, read[tick - 5])] if tick >= 5 else [], heights=heights)
    )
    alone, _ = errors(follow((), lambda _tick: [], heights=heights))
    assert rms(at_once) <= rms(delayed) < 0.7 * rms(alone)
    assert rms(delayed) < 0.9 * rms(ignored)


def test_a_sensor_that_jumps_is_left_out_and_comes_back():
    heights, read = noisy(TRUTH.height_m, NOISE_M, 1), noisy(TRUTH.force_n, 0.5, 2)
    read[1500:2500] += 200.0
    outputs = follow((CELL,), lambda tick: [(0, read[tick])], heights=heights)
    out = [tick for tick, output in enumerate(outputs) if output.left_out]
    assert out == list(range(1504, 2549))  # five beyond the gate; fifty within it
    missed, _ = errors(outputs)
    alone, _ = errors(follow((), lambda _tick: [], heights=heights))
    assert rms(missed[1100:1900]) < 1.1 * rms(alone[1100:1900])


def test_a_silent_sensor_is_left_out_and_said():
    heights, read = noisy(TRUTH.height_m, NOISE_M, 1), noisy(TRUTH.force_n, 0.5, 2)
    outputs = follow(
        (CELL,), lambda tick: [] if 1500 <= tick < 1600 else [(0, read[tick])], heights=heights
    )
    out = [tick for tick, output in enumerate(outputs) if output.left_out]
    assert out == list(range(1505, 1600))


def test_another_height_carries_on_where_the_struts_own_is_lost():
    heights = noisy(TRUTH.height_m, NOISE_M, 1)
    heights[1500:2500] = np.nan
    read = noisy(TRUTH.height_m, 1e-5, 2)
    outputs = follow(
        (WIRE,), lambda tick: [(0, read[tick])] if tick % 5 == 0 else [], heights=heights
    )
    assert {output.mode for output in outputs[100:]} == {Mode.RUNNING}
    missed, std_n = errors(outputs)
    assert np.mean(np.abs(missed[1100:1900]) < 1.96 * std_n[1100:1900]) > 0.9
    without = follow((), lambda _tick: [], heights=heights)
    assert {output.mode for output in without[1700:1900]} == {Mode.HOLD}
    # A force or a velocity alone does not keep the model where the bench is.
    cell = follow((CELL,), lambda tick: [(0, TRUTH.force_n[tick])], heights=heights)
    assert {output.mode for output in cell[1700:1900]} == {Mode.HOLD}


def test_a_sensor_that_is_out_does_not_come_back_without_the_reference():
    heights, read = noisy(TRUTH.height_m, NOISE_M, 1), TRUTH.height_m.copy()
    read[900:] += 5e-3
    heights[1000:1400] = np.nan
    wire = sensor("strut.wire", HEIGHT, 1e-5, MS)
    outputs = follow((wire,), lambda tick: [(0, read[tick])], heights=heights)
    # While the model starts again there is no estimate that a sensor could be left out of.
    assert all(output.left_out for output in outputs[910:] if output.mode is not Mode.HOLD)
    assert not any(output.struts[0].valid for output in outputs[1100:1390])
    missed, _ = errors(outputs)
    assert rms(missed[1000:]) < 20.0


def test_two_steps_at_one_time_keep_the_input_of_both():
    core = supervised(TRUTH.plant, (kalman(),), SUPERVISION, channels(1, sensors=(WIRE,)))
    state = core.init(0)
    for tick in range(100):
        state, _, _ = core.step(state, measured(tick, 0.4 + 1e-5 * tick))
    for height_m in (0.40, 0.41):
        sample = Sample(0, height_m, 100 * MS)
        state, output, _ = core.step(state, StepInput(100 * MS, (sample,)))
    state, _, _ = core.step(state, StepInput(101 * MS, (Sample(0, 0.4, 101 * MS),)))
    inputs = dict(state.estimator.observers.joint.inputs)
    assert inputs[100 * MS] == output.struts[0].virtual_force_n
