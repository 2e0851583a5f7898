"""A dyno's tick: the motion is followed, the model driven along it, the load cell compared."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.database import Message
from can_dbc.errors import InputError
from dart_model.plant import PrescribedStrut
from dart_model.spec import MODELS, EffectSpec, load_model, parse_model
from rig.bridge.measured_inputs import MovedInput
from rig.bridge.mode_supervisor import Supervision, Supervisor
from rig.bridge.prescribed_motion import PrescribedMotionEstimator, PrescribedMotionState
from rig.bridge.tracked_motion import (
    TrackedMotion,
    accelerate,
    error_gains,
    lag_free_hz,
    predict_motion,
    update_motion,
    update_with_acceleration,
)
from rig.bridge.values import Mode, Request, StepInput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import APPLIED_FORCE, LOAD_CELL_FORCE, MOTION, TEMPERATURE
from tests.bridge.cores import bench_sample, channels

MODEL = """
name: dyno
gravity_m_per_s2: 9.81
skeleton:
  bodies:
    - {name: rod, mass_kg: 2.0, joint: {type: prismatic, axis: [0, 0, 1], parent: world}}
struts:
  - name: strut
    between: [world, rod]
    free_length_m: 0.3
    stiffness_n_per_m: 5000.0
    damping_n_s_per_m: 2000.0
"""
TICK_NS = 1_000_000
UNTIMED = Message(Path(), "M", 1, False, False, False, 8, None, None, {}, None)
"""A message of which the DBC does not know how often it comes."""
SETTLED = 18
"""Tick after that of the first height at which the motion is believed."""

SUPERVISION = Supervision(stale_after_s=0.005, safe_after_s=0.05)


def plant(*effects: EffectSpec) -> PrescribedStrut:
    return PrescribedStrut(parse_model(MODEL, "dyno").with_effects("strut", effects))


def motion(t_s: float) -> tuple[float, float]:
    omega = 2.0 * math.pi * 3.0
    return 0.3 + 0.01 * math.sin(omega * t_s), 0.01 * omega * math.cos(omega * t_s)


def cell(number: int) -> float:
    """Force of a spring and a damper along the motion."""
    height_m, velocity = motion(number * 1e-3)
    return -5000.0 * (height_m - 0.3) - 2000.0 * velocity


def step_input(number: int, cell_n: float | None, *, measured: bool = True) -> StepInput:
    t_ns = number * TICK_NS
    samples = [Sample(0, motion(t_ns * 1e-9)[0], t_ns)] if measured else []
    if cell_n is not None:
        samples.append(bench_sample(1, LOAD_CELL_FORCE, cell_n, t_ns))
    return StepInput(t_ns, tuple(samples))


def dyno(strut: PrescribedStrut, supervision: Supervision = SUPERVISION) -> Supervisor:
    stale_after_ns = supervision.stale_after_ns
    estimator = PrescribedMotionEstimator(strut, 0.002, channels(1), stale_after_ns)
    return Supervisor(estimator, supervision, [supervision.limits])


def test_the_filter_follows_a_constant_acceleration_without_lag() -> None:
    tracked = TrackedMotion(0.3, 0.0, 0.0, 0.0, 0)
    for number in range(1, 200):
        t_s = number * 1e-3
        height_m = 0.3 + 0.2 * t_s + 0.5 * 1.5 * t_s * t_s
        tracked = update_motion(tracked, Sample(0, height_m, number * TICK_NS), 0.002)
    assert tracked.velocity_m_per_s == pytest.approx(0.2 + 1.5 * 0.199, abs=1e-9)
    assert tracked.acceleration_m_per_s2 == pytest.approx(1.5, abs=1e-6)
    height_m, velocity, _ = predict_motion(tracked, 204 * TICK_NS)
    assert height_m == pytest.approx(0.3 + 0.2 * 0.204 + 0.75 * 0.204**2, abs=1e-9)
    assert velocity == pytest.approx(0.2 + 1.5 * 0.204, abs=1e-7)


def test_a_measurement_that_is_not_newer_changes_nothing() -> None:
    tracked = TrackedMotion(0.3, 0.1, 0.0, 0.0, 5)
    assert update_motion(tracked, Sample(0, 0.4, 5), 0.002) is tracked


def test_the_virtual_force_is_what_the_cell_shows_beyond_the_model() -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(400):
        height_m, velocity = motion(number * 1e-3)
        law_n = -5000.0 * (height_m - 0.3) - 2000.0 * velocity
        state, output, _ = core.step(state, step_input(number, law_n + 37.0))
        if number > 50:
            (strut,) = output.struts
            assert strut.valid
            assert strut.force_n == law_n + 37.0
            assert strut.virtual_force_n == pytest.approx(37.0, abs=2.5)
            assert strut.velocity_m_per_s == pytest.approx(velocity, abs=1.2e-3)


def test_what_effects_remember_is_led_along_the_motion() -> None:
    branch = EffectSpec(
        name="maxwell", parameters={"stiffness_n_per_m": 8000.0, "relaxation_time_s": 0.03}
    )
    core = dyno(plant(branch))
    state = core.init(0)
    deflection_m, virtual = 0.0, []
    for number in range(600):
        t_s = number * 1e-3
        height_m, velocity = motion(t_s)
        truth_n = -5000.0 * (height_m - 0.3) - 2000.0 * velocity - 8000.0 * deflection_m
        state, output, _ = core.step(state, step_input(number, truth_n))
        virtual.append(output.struts[0].virtual_force_n)
        for fine in range(100):
            at_s = t_s + (fine + 0.5) * 1e-5
            deflection_m += 1e-5 * (motion(at_s)[1] - deflection_m / 0.03)
    assert max(abs(force) for force in virtual[200:]) < 3.0


def test_a_measured_temperature_holds_until_the_next() -> None:
    fade = EffectSpec(
        name="linear_temperature_fade", parameters={"fraction_per_k": 0.01, "reference_c": 20.0}
    )
    core = dyno(plant(fade))
    state = core.init(0)
    for number in range(400):
        height_m, velocity = motion(number * 1e-3)
        warm = 45.0 if number >= 100 else 20.0
        law_n = -5000.0 * (height_m - 0.3) - 2000.0 * (1.0 - 0.01 * (warm - 20.0)) * velocity
        measured = {20.0: None, 45.0: 45.0 if number == 100 else None}[warm]
        t_ns = number * TICK_NS
        samples = [Sample(0, height_m, t_ns), bench_sample(1, LOAD_CELL_FORCE, law_n, t_ns)]
        if measured is not None:
            samples.append(bench_sample(1, TEMPERATURE, measured, t_ns))
        state, output, _ = core.step(state, StepInput(t_ns, tuple(samples)))
        if number > 110:
            assert state.estimator.temperature_c == 45.0
            assert output.struts[0].virtual_force_n == pytest.approx(0.0, abs=2.5)


def test_the_safe_state_publishes_the_last_valid_force_where_that_is_asked_for() -> None:
    holds = SUPERVISION.model_copy(update={"safe_output": "last"})
    core = dyno(plant(), holds)
    state = core.init(0)
    for number in range(20):
        state, output, _ = core.step(state, step_input(number, 100.0 + number))
    for number in range(20, 120):
        state, output, _ = core.step(state, step_input(number, None, measured=False))
    assert output.mode is Mode.SAFE
    assert not output.struts[0].valid
    # The cell's last force counts as valid as long as it is fresh.
    assert output.struts[0].force_n == 119.0


def test_effects_age_with_the_time_of_the_run() -> None:
    fade = EffectSpec(name="time_fade", parameters={"final_fraction": 0.0, "time_constant_s": 0.5})
    core = dyno(plant(fade))
    state = core.init(0)
    for number in range(1500):
        height_m, velocity = motion(number * 1e-3)
        left = math.exp(-number * 1e-3 / 0.5)
        law_n = -5000.0 * (height_m - 0.3) - 2000.0 * left * velocity
        state, output, _ = core.step(state, step_input(number, law_n))
        if number > 50:
            assert output.struts[0].virtual_force_n == pytest.approx(0.0, abs=3.0)


def test_nothing_is_said_before_both_channels_came() -> None:
    core = dyno(plant())
    state, output, _ = core.step(core.init(0), step_input(0, None))
    assert output.mode is Mode.WAITING
    assert output.struts == ()
    state, output, _ = core.step(state, step_input(1, 12.0))
    assert output.mode is Mode.SETTLING
    assert output.struts[0].force_n == 12.0


def test_the_motion_is_valid_when_the_filter_has_forgotten_its_start() -> None:
    """Nine time constants of 2 ms, from the first height on."""
    core = dyno(plant())
    state = core.init(0)
    for number in range(40):
        state, output, _ = core.step(state, step_input(number, 12.0))
        assert output.mode is (Mode.SETTLING if number < SETTLED else Mode.RUNNING)
        assert output.struts[0].valid == (number >= SETTLED)


@pytest.mark.parametrize("missing", [2, 3, 9, 10, 30])
def test_after_three_intervals_without_a_height_the_motion_settles_again(missing: int) -> None:
    core = dyno(plant())
    state = core.init(0)
    modes: list[Mode] = []
    for number in range(140):
        is_there = not 40 <= number < 40 + missing
        state, output, _ = core.step(state, step_input(number, cell(number), measured=is_there))
        modes.append(output.mode)
    back = 40 + missing
    settling = SETTLED if missing > 2 else 0
    assert set(modes[40:43]) == {Mode.RUNNING}
    assert set(modes[43:45]) <= ({Mode.SETTLING} if settling else {Mode.RUNNING})
    assert set(modes[45:back]) <= {Mode.HOLD}
    assert set(modes[back : back + settling]) == ({Mode.SETTLING} if settling else set())
    assert set(modes[back + settling :]) == {Mode.RUNNING}


@pytest.mark.parametrize("missing", [2, 3, 4])
def test_a_force_older_than_three_intervals_is_not_believed(missing: int) -> None:
    """It is as soon as another one is there: a load cell does not settle."""
    core = dyno(plant())
    state = core.init(0)
    for number in range(90):
        quiet = 40 <= number < 40 + missing
        state, output, _ = core.step(state, step_input(number, None if quiet else cell(number)))
        if number > 40:
            overdue = quiet and number >= 43
            assert output.mode is (Mode.SETTLING if overdue else Mode.RUNNING)


def test_a_force_is_as_old_as_its_sample() -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(60):
        t_ns = number * TICK_NS
        height = Sample(0, motion(t_ns * 1e-9)[0], t_ns)
        sampled_ns = t_ns - (4 * TICK_NS if number >= 40 else 0)
        late = bench_sample(1, LOAD_CELL_FORCE, cell(number), sampled_ns)
        state, output, _ = core.step(state, StepInput(t_ns, (height, late)))
        if number > 45:
            assert output.mode is Mode.SETTLING


@pytest.mark.parametrize("first", [1000, 1083, 1125])
def test_a_height_that_freezes_while_it_moves_is_not_believed(first: int) -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(2000):
        t_ns = number * TICK_NS
        height_m = motion(min(number, first - 1) * 1e-3)[0]
        samples = (Sample(0, height_m, t_ns), bench_sample(1, LOAD_CELL_FORCE, cell(number), t_ns))
        state, output, _ = core.step(state, StepInput(t_ns, samples))
        if number >= SETTLED:
            assert output.mode is (Mode.RUNNING if number < first else Mode.SETTLING)


@pytest.mark.parametrize("jump_m", [1e-4, -1e-3, 1e-2])
def test_a_motion_behind_a_jump_settles_again(jump_m: float) -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(1200):
        t_ns = number * TICK_NS
        height_m = motion(t_ns * 1e-9)[0] + (jump_m if number >= 1000 else 0.0)
        cell_n = bench_sample(1, LOAD_CELL_FORCE, cell(number), t_ns)
        state, output, _ = core.step(state, StepInput(t_ns, (Sample(0, height_m, t_ns), cell_n)))
        if SETTLED <= number < 1000 or number >= 1000 + 3 * SETTLED:
            assert output.mode is Mode.RUNNING
        elif 1000 <= number < 1000 + SETTLED:
            assert output.mode is Mode.SETTLING


def test_a_sensor_whose_intervals_scatter_is_believed() -> None:
    """Of 2 to 8 ms, and in bursts."""
    rng = np.random.default_rng(1)
    scattered = np.cumsum(rng.integers(2, 9, 1000))
    bursts = [start + item for start in range(0, 4000, 40) for item in range(10)]
    for times in (scattered, bursts):
        core, arrivals = untimed_dyno(), {int(t) for t in times}
        state, modes = core.init(0), list[Mode]()
        for number in range(4000):
            is_there = number in arrivals
            given = step_input(number, cell(number)) if is_there else StepInput(number * TICK_NS)
            state, output, _ = core.step(state, given)
            modes.append(output.mode)
        assert set(modes[400:]) == {Mode.RUNNING}


def untimed_dyno() -> Supervisor:
    """A dyno of whose sensors the DBC has no cycle time."""
    supervision = Supervision(stale_after_s=0.2, safe_after_s=1.0)
    untimed = [dataclasses.replace(channel, message=UNTIMED) for channel in channels(1)]
    estimator = PrescribedMotionEstimator(plant(), 0.002, untimed, supervision.stale_after_ns)
    return Supervisor(estimator, supervision, [supervision.limits])


@pytest.mark.parametrize("interval", [1, 5, 20])
def test_the_interval_of_a_sensor_without_a_cycle_time_is_learnt(interval: int) -> None:
    core = untimed_dyno()
    state = core.init(0)
    for number in range(2000):
        given = StepInput(number * TICK_NS, ())
        if number % interval == 0 and not 1500 <= number < 1500 + 8 * interval:
            given = step_input(number, cell(number))
        state, output, _ = core.step(state, given)
        since = number - (1500 + 8 * interval)
        if 100 <= number < 1500 or since > 100:
            assert output.mode is Mode.RUNNING
        elif -4 * interval <= since < 0:
            assert output.mode is Mode.SETTLING


@pytest.mark.parametrize("silent", ["height", "cell"])
def test_a_channel_that_falls_silent_ends_in_the_safe_state(silent: str) -> None:
    core = dyno(plant())
    state = core.init(0)
    modes: list[Mode] = []
    for number in range(120):
        quiet = number > 20
        cell_n = None if quiet and silent == "cell" else 5.0
        given = step_input(number, cell_n, measured=not (quiet and silent == "height"))
        state, output, _ = core.step(state, given)
        modes.append(output.mode)
    assert modes[23:27] == [Mode.RUNNING, Mode.SETTLING, Mode.SETTLING, Mode.HOLD]
    assert modes[70:72] == [Mode.HOLD, Mode.SAFE]
    assert output.struts[0].force_n == 0.0
    assert not output.struts[0].valid
    for given in (StepInput(119 * TICK_NS), step_input(120, 5.0)):
        acknowledged = StepInput(given.t_ns, given.samples, request=Request.ACKNOWLEDGE)
        state, output, _ = core.step(state, acknowledged)
        # Without a fresh measurement of both it is refused.
        assert output.mode is (Mode.WAITING if given.samples else Mode.SAFE)
    # A motion that was measured all the time has settled in the safe state.
    settling = SETTLED - 1 if silent == "height" else 0
    for number in range(121, 121 + settling):
        state, output, _ = core.step(state, step_input(number, 5.0))
        assert output.mode is Mode.SETTLING
    state, output, _ = core.step(state, step_input(121 + settling, 5.0))
    assert output.mode is Mode.RUNNING


def test_the_force_is_the_law_of_spring_and_damper() -> None:
    strut = plant()
    force_n = strut.force_n(strut.init(0.0), 0.32, 0.5, 20.0)
    assert force_n == pytest.approx(-5000.0 * 0.02 - 2000.0 * 0.5, abs=1e-9)


def test_two_struts_are_refused() -> None:
    with pytest.raises(InputError, match="2 struts, expected one") as caught:
        PrescribedStrut(load_model(MODELS / "quarter_car.yaml"))
    assert "\n" not in str(caught.value)


def estimator(measured: Sequence[Channel] | None = None) -> PrescribedMotionEstimator:
    return PrescribedMotionEstimator(plant(), 0.002, measured or channels(1), 5 * TICK_NS)


def follow(
    core: PrescribedMotionEstimator, numbers: Sequence[int], state: PrescribedMotionState
) -> PrescribedMotionState:
    for number in numbers:
        state, _ = core.step(state, step_input(number, cell(number)))
    return state


def test_before_a_height_there_is_none_and_one_strut() -> None:
    core = estimator()
    assert core.struts == 1
    state = core.init(7)
    assert (state.t_ns, state.disturbed_ns) == (7, 0)
    assert core.heights_m(state) == ()
    state = follow(core, range(3), state)
    assert core.heights_m(state) == (pytest.approx(motion(0.002)[0], abs=1e-4),)


def test_an_estimator_that_starts_again_waits_for_both() -> None:
    core = estimator()
    state = follow(core, range(100), core.init(0))
    assert state.is_moving
    assert state.is_settled
    again = core.restart(state, 100 * TICK_NS)
    assert again == PrescribedMotionState(100 * TICK_NS, state.temperature_c)
    assert not again.is_moving
    assert not again.is_settled


@pytest.mark.parametrize(("missing", "is_followed"), [(9, True), (10, False)])
def test_after_more_than_ten_intervals_the_motion_is_followed_from_rest(
    missing: int, is_followed: bool
) -> None:
    core = estimator()
    state = follow(core, range(100), core.init(0))
    behind, _ = core.collect(state, step_input(100 + missing, None))
    assert behind.motion is not None
    tracked = (behind.motion.velocity_m_per_s, behind.motion.acceleration_m_per_s2)
    assert (tracked != (0.0, 0.0)) == is_followed
    assert behind.disturbed_ns == (100 + missing) * TICK_NS
    if not is_followed:
        assert behind.motion.innovation_m == 0.0
        # The model is where it was.
        assert behind.model == state.model


@pytest.mark.parametrize("value", [1e13, -1e13, math.nan])
@pytest.mark.parametrize("of_cell", [True, False])
def test_what_no_bench_has_ends_in_the_safe_state(value: float, of_cell: bool) -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(60):
        t_ns = number * TICK_NS
        is_wrong = number >= 50
        height_m = value if is_wrong and not of_cell else motion(t_ns * 1e-9)[0]
        cell_n = value if is_wrong and of_cell else cell(number)
        samples = (Sample(0, height_m, t_ns), bench_sample(1, LOAD_CELL_FORCE, cell_n, t_ns))
        state, output, _ = core.step(state, StepInput(t_ns, samples))
        assert (output.mode is Mode.SAFE) == is_wrong


def test_a_sample_that_is_not_newer_replaces_none() -> None:
    core = estimator()
    state = follow(core, range(100), core.init(0))
    again, _ = core.collect(state, step_input(99, 1e6))
    assert again == state


def test_an_old_height_is_as_old_as_its_delay_makes_it() -> None:
    """Heights that arrive 8 ms late have an age of 8 ms, at 1 ms between them."""
    measured = channels(1, delay_ns=8 * TICK_NS)
    core = PrescribedMotionEstimator(plant(), 0.002, measured, 50 * TICK_NS)
    state = core.init(0)
    for number in range(8, 160):
        t_ns, sampled_ns = number * TICK_NS, (number - 8) * TICK_NS
        height = Sample(0, motion(sampled_ns * 1e-9)[0], sampled_ns)
        given = (height, bench_sample(1, LOAD_CELL_FORCE, cell(number), t_ns))
        if number < 140:
            state, found = core.step(state, StepInput(t_ns, given))
        else:
            state, found = core.step(state, StepInput(t_ns, given[1:]))
        if number > 60:
            assert found is not None
            # The last height was true at 131 ms, and came at 139.
            assert found.is_settled == (number - 131 <= 11 or number < 140)


def test_the_interval_that_a_dbc_states_is_not_learnt() -> None:
    core = dyno(plant(), Supervision(stale_after_s=0.05, safe_after_s=1.0))
    state = core.init(0)
    modes: list[Mode] = []
    for number in range(300):
        is_there = number % 5 == 0
        given = step_input(number, cell(number)) if is_there else StepInput(number * TICK_NS)
        state, output, _ = core.step(state, given)
        modes.append(output.mode)
    assert set(modes[50:]) == {Mode.SETTLING}


def test_other_quantities_are_none_of_its_concern() -> None:
    core = estimator()
    state = follow(core, range(3), core.init(0))
    applied = bench_sample(1, APPLIED_FORCE, 77.0, 3 * TICK_NS)
    after, _ = core.collect(state, StepInput(3 * TICK_NS, (applied,)))
    assert after == replace(state, t_ns=3 * TICK_NS)


def test_the_motion_is_published_while_heights_are_missing() -> None:
    core = dyno(plant())
    state = core.init(0)
    for number in range(80):
        state, output, _ = core.step(state, step_input(number, cell(number), measured=number < 60))
    assert output.mode is Mode.HOLD
    assert output.struts[0].height_m != 0.0
    assert not output.struts[0].valid
    assert output.struts[0].force_n == cell(79)


@pytest.mark.parametrize("interval_ms", [1, 5])
def test_the_filters_gains_are_those_of_a_triple_pole(interval_ms: int) -> None:
    """Morrison's: 1 - p^3, 1.5 (1 - p)^2 (1 + p) over the interval, (1 - p)^3 over its square."""
    interval_s, pole = interval_ms * 1e-3, math.exp(-interval_ms / 2.0)
    rest = TrackedMotion(0.0, 0.0, 0.0, 0.0, 0)
    after = update_motion(rest, Sample(0, 1.0, interval_ms * TICK_NS), 0.002)
    assert after.position_m == pytest.approx(1.0 - pole**3)
    velocity = 1.5 * (1.0 - pole) ** 2 * (1.0 + pole) / interval_s
    assert after.velocity_m_per_s == pytest.approx(velocity)
    assert after.acceleration_m_per_s2 == pytest.approx((1.0 - pole) ** 3 / interval_s**2)
    assert after.innovation_m == 1.0


# --- The filter's error, as the check reports it -------------------------------------------------


@pytest.mark.parametrize("settling_s", [0.0015, 0.004])
@pytest.mark.parametrize("has_acceleration", [False, True])
def test_noise_of_positions_is_passed_on_as_reported(settling_s, has_acceleration):
    update = update_with_acceleration if has_acceleration else update_motion
    noise = np.random.default_rng(3).standard_normal(20_000)
    motion, passed = TrackedMotion(0.0, 0.0, 0.0, 0.0, 0), []
    for number, value in enumerate(noise.tolist(), start=1):
        motion = update(motion, Sample(0, value, number * TICK_NS), settling_s)
        ahead = predict_motion(motion, (number + 5) * TICK_NS)
        known = motion.position_m, motion.velocity_m_per_s, motion.innovation_m
        passed.append([*known, *ahead[:2]])
    reported = error_gains(settling_s, 1e-3, has_acceleration=has_acceleration)
    found = np.cov(np.array(passed[100:]).T)
    assert np.allclose(found[:2, :2], reported.noise[:2, :2], rtol=0.06)
    assert np.allclose(found[3:, 3:], reported.ahead(5e-3)[0], rtol=0.06)
    assert found[2, 2] == pytest.approx(reported.innovation, rel=0.04)
    changes = np.diff(np.array(passed[100:])[:, 2])
    assert np.mean(changes**2) == pytest.approx(reported.change, rel=0.04)


@pytest.mark.parametrize("frequency_hz", [5.0, 20.0])
def test_noise_and_lag_of_a_motion_are_those_of_its_errors(frequency_hz):
    noise_m, omega, rng = 5e-6, 2.0 * math.pi * frequency_hz, np.random.default_rng(4)
    channel = Channel(0, Role.INPUT, MOTION, "road", "road", -1, TICK_NS)
    item = MovedInput(channel, None, 0.002)
    state, errors = None, []
    for number in range(1, 8000):
        t_s = number * 1e-3
        value = 1e-3 * math.sin(omega * t_s) + noise_m * float(rng.standard_normal())
        state = item.update(state, Sample(0, value, number * TICK_NS))
        truth = 1e-3 * omega * math.cos(omega * t_s)
        errors.append(item.values(state, number * TICK_NS)[1] - truth)
    noise_m2, lag_m2 = item.squares_m2(state)
    noise, lag = item.gains.ahead(0.0)
    stated = noise[1, 1] * noise_m2 + lag[1] ** 2 * lag_m2
    assert noise_m2 == pytest.approx(noise_m**2, rel=0.2)
    assert np.mean(np.square(errors[2000:])) == pytest.approx(stated, rel=0.15)
    # After a gap the errors are those that there were before.
    again = item.update(state, Sample(0, 0.0, 9000 * TICK_NS))
    assert not item.is_ready(again)
    assert item.squares_m2(again) == (noise_m2, lag_m2)


@pytest.mark.parametrize("settling_s", [0.0015, 0.004])
def test_up_to_the_reported_frequency_the_lag_is_below_the_share(settling_s):
    omega = 2.0 * np.pi * lag_free_hz(settling_s, 1e-3)
    motion, errors = TrackedMotion(0.0, 0.0, 0.0, 0.0, 0), []
    for number in range(1, 4000):
        truth = math.sin(omega * number * 1e-3)
        motion = update_motion(motion, Sample(0, truth, number * TICK_NS), settling_s)
        errors.append(abs(motion.position_m - truth))
    assert 2e-4 < max(errors[1000:]) < 1e-3


def test_a_measured_acceleration_leaves_no_lag():
    """The position is a cubic: its acceleration is not constant."""
    motion = TrackedMotion(0.0, 0.0, 0.0, 0.0, 0)
    for number in range(1, 400):
        t_s = number * 1e-3
        motion = update_with_acceleration(motion, Sample(0, t_s**3, number * TICK_NS), 0.002)
        motion = accelerate(motion, Sample(1, 6.0 * t_s, number * TICK_NS))
    position_m, velocity, acceleration = predict_motion(motion, 400 * TICK_NS)
    assert position_m == pytest.approx(0.4**3, abs=2e-8)
    assert velocity == pytest.approx(3.0 * 0.4**2, abs=4e-3)
    assert acceleration == pytest.approx(6.0 * 0.399)


@pytest.mark.parametrize("has_acceleration", [False, True])
def test_lag_of_a_prediction_is_that_behind_a_constant_jerk(has_acceleration):
    """By a cubic, or with a measured acceleration that is wrong a parabola, in closed form."""
    update = update_with_acceleration if has_acceleration else update_motion
    power, ahead_ns, motion = (
        2 if has_acceleration else 3,
        7 * TICK_NS,
        TrackedMotion(0.0, 0.0, 0.0, 0.0, 0),
    )
    for number in range(1, 400):
        t_s = number * 1e-3
        motion = update(motion, Sample(0, t_s**power, number * TICK_NS), 0.004)
    later_s = t_s + 1e-9 * ahead_ns
    truth = np.array([later_s**power, power * later_s ** (power - 1)])
    missed = np.array(predict_motion(motion, motion.measured_ns + ahead_ns)[:2]) - truth
    _, lag = error_gains(0.004, 1e-3, has_acceleration=has_acceleration).ahead(1e-9 * ahead_ns)
    assert lag * motion.innovation_m == pytest.approx(missed, rel=1e-3)
