"""The joint filter: against the filter of one strut, against theory, and in closed loop."""

import dataclasses
import math

import numpy as np
import pytest
from msgspec.structs import replace
from pydantic import TypeAdapter

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import FORCE, VELOCITY
from rig.closed_loop.loop import Loop, SampleTiming
from rig.closed_loop.strut_response import linearise_at
from rig.observers import OBSERVERS
from rig.observers.error_filter import ErrorFilter
from rig.observers.joint_filter import JointFilter
from rig.observers.joint_model import FollowedStrut, JointModel
from rig.observers.protocol import REFERENCE_HEIGHT, Innovation, Start
from rig.observers.strut_observers import ObserversState, StrutObservers

MS = 1_000_000
REST_M = (0.29, 0.35)
NOISE_M = 5e-6


def observer(kind="kalman", bandwidth_hz=25.0):
    given = {
        "kalman": {
            "kind": "kalman",
            "filter": {"bandwidth_hz": bandwidth_hz, "noise_std_m": NOISE_M},
        },
        "pi": {},
        "none": {"kind": "none"},
        "measured": {"kind": "none", "noise_std_m": NOISE_M},
    }[kind]
    return TypeAdapter(OBSERVERS[given.get("kind", "pi")]).validate_python(given)


@pytest.fixture(scope="module")
def plant():
    return DartPlant(load_model(MODELS / "quarter_car.yaml"))


@pytest.fixture(scope="module")
def car(plant):
    """Motion of the quarter car: a wheel of 3 kg and a body of 15 kg."""
    return linearise_at(plant, REST_M)


def starts_of(model, sensors=((), ()), interval_ns=MS, delay_ns=0):
    return [
        Start(0, mobility, interval_ns, delay_ns, stiffness, damping, tuple(of_strut))
        for (mobility, stiffness, damping), of_strut in zip(
            model.responses(), sensors, strict=False
        )
    ]


def joint_of(model, kinds=("kalman", "kalman"), bandwidth_hz=25.0, **timing):
    """Joint filter of struts with observers of some kinds."""
    starts, each = starts_of(model, **timing), [observer(kind, bandwidth_hz) for kind in kinds]
    followed = [
        FollowedStrut(i, it.height_std_m, it.force_filter)
        for i, it in enumerate(each)
        if it.height_std_m is not None
    ]
    return JointModel(model, starts, followed)


def test_mobilities_are_those_of_the_masses(car):
    wheel, body = 3.0, 15.0
    expected = [[1 / wheel, -1 / wheel], [-1 / wheel, 1 / wheel + 1 / body]]
    assert car.mobility_per_kg == pytest.approx(np.array(expected), rel=1e-6)
    assert car.moves_another(0)
    alone = linearise_at(DartPlant(load_model(MODELS / "reference.yaml")), [0.4])
    assert not alone.moves_another(0)


def test_the_struts_of_a_model_fall_back_as_its_laws_say(car):
    """Accelerations are free of the laws' forces but for these, and those are the laws'."""
    assert np.abs(car.free).max() < 1e-3
    k, c = np.array([20000.0, 800.0]), np.array([130.0, 120.0])
    expected = -np.hstack([k[:, None] * car.heights, c[:, None] * car.heights])
    assert car.laws == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("bandwidth_hz", [5.0, 25.0, 60.0])
def test_of_one_strut_it_is_the_filter_of_one_strut(bandwidth_hz, delay, monkeypatch):
    """But for the forgetting, which the filter of one strut has not."""
    monkeypatch.setattr("rig.observers.joint_model._FORGETTING", 1e-7)
    model = linearise_at(DartPlant(load_model(MODELS / "reference.yaml")), [0.4])
    one, delay_ns = observer(bandwidth_hz=bandwidth_hz), delay * MS
    timing = {"sensors": ((),), "delay_ns": delay_ns}
    (start,) = starts_of(model, **timing)
    joint = JointFilter(joint_of(model, ("kalman",), bandwidth_hz, **timing))
    alone, state = one.init(start), joint.init(0)
    rng = np.random.default_rng(1)
    heights = 1e-5 * np.sin(0.005 * np.arange(400)) + NOISE_M * rng.standard_normal(400)
    for tick in range(1, 400):
        t_ns = tick * MS
        seen = None if tick % 37 == 0 else Innovation(heights[tick], t_ns - delay_ns)
        alone = one.step(alone, t_ns, seen)
        state = joint.step(state, t_ns, [seen], [[]], [1e4] * len(joint.followed))
        (found,) = state.struts
        # A thousandth: the one filter has constant gains where the other's come ever closer.
        assert found.virtual_force_n == pytest.approx(alone.virtual_force_n, rel=1e-3, abs=1e-2)
        assert found.residual_force_n == pytest.approx(alone.residual_force_n, rel=1e-3, abs=1e-2)
        # The one filter learns the noise while it is steady, the other always.
        noise = [found.force_std_n / state.references[0].scale ** 0.5]
        assert noise == pytest.approx([alone.force_std_n / alone.error.scale**0.5], rel=0.03)
        # No model answers to the virtual forces here.
        still = ((t_ns, np.zeros(1)),)
        state = replace(state, inputs=still, used=())
        alone = replace(alone, error=replace(alone.error, inputs=((t_ns, 0.0),)))


def test_steady_variances_are_those_that_an_update_returns_to(car):
    model = joint_of(car, ("kalman", "measured"))
    ahead = model.ahead(model.steady, 16)
    for strut in (0, 1):
        line = model.lines[REFERENCE_HEIGHT, strut].scaled
        seen = ahead @ line
        ahead = ahead - np.outer(seen, seen) / (line @ seen + 1.0)
    assert np.allclose(ahead, model.steady, rtol=1e-6, atol=1e-9 * np.abs(model.steady).max())
    assert np.all(np.linalg.eigvalsh(model.steady) > -1e-9)


@pytest.mark.parametrize(
    "kinds", [("kalman", "kalman"), ("none", "kalman"), ("measured", "kalman")]
)
def test_stated_deviations_are_those_of_the_errors(car, kinds):
    """A bench that moves as the filter assumes: its own random walks, and noise of its sensors."""
    model = joint_of(car, kinds)
    joint = JointFilter(model)
    transition, added = model._transition(16)
    root = np.linalg.cholesky(added + 1e-12 * np.diag(np.diagonal(added) + 1e-12))
    rng = np.random.default_rng(3)
    truth = np.zeros(model.size)
    state, errors = joint.steady_state(0), []
    for tick in range(1, 12_001):
        # Only differences to what the virtual force does are unknown: the model stays, and moves
        # the truth by its force.
        push = model.mean_at(np.zeros(model.size), 0, MS, state.inputs[-1:], model.motion)
        truth = transition @ truth + root @ rng.standard_normal(model.size) + push / model.units
        t_ns = tick * MS
        seen = [None, None]
        for strut in model.followed:
            row, std, _ = model.lines[REFERENCE_HEIGHT, strut]
            seen[strut] = Innovation(
                float(row @ (model.units * truth)) + std * rng.standard_normal(), t_ns
            )
        state = joint.step(state, t_ns, seen, [[], []], [1e4] * len(joint.followed))
        if tick > 2000:
            real = model._scaled_forces @ truth
            found = [it.residual_force_n for it in state.struts]
            errors.append((found - real) / np.sqrt(np.diagonal(state.covariance_n2)))
    within = np.mean(np.abs(errors) < 1.96, axis=0)
    assert np.all((within > 0.92) & (within < 0.985))


def test_a_constant_force_is_found_in_each_strut(car):
    """Two forces that are constant: the published ones are these, and both heights follow."""
    model = joint_of(car)
    joint = JointFilter(model)
    state, truth = joint.steady_state(0), np.zeros(model.size)
    truth[model.forces] = 30.0, -50.0
    constant = model.motion.generator.copy()
    constant[model.forces.start :] = 0.0
    motion = model.motion._replace(generator=constant)
    for tick in range(1, 3001):
        truth = model.mean_at(truth, 0, MS, state.inputs[-1:], motion)
        t_ns = tick * MS
        heights = [model.lines[REFERENCE_HEIGHT, strut].row @ truth for strut in (0, 1)]
        state = joint.step(
            state,
            t_ns,
            [Innovation(h, t_ns) for h in heights],
            [[], []],
            [1e4] * len(joint.followed),
        )
    assert [it.virtual_force_n for it in state.struts] == pytest.approx([30.0, -50.0], rel=1e-5)
    assert np.abs(heights).max() < 1e-8


@pytest.mark.parametrize("bandwidth_hz", [3.0, 12.0, 25.0, 50.0, 100.0])
@pytest.mark.parametrize(
    "kinds", [("kalman", "kalman"), ("none", "kalman"), ("kalman", "measured")]
)
def test_noise_aware_observers_of_a_quarter_car_are_stable(plant, bandwidth_hz, kinds):
    """At bandwidths below the natural frequencies of its bodies, too (1.1 and 13.7 Hz)."""
    observers = [observer(kind, bandwidth_hz) for kind in kinds]
    loop = Loop(plant, observers, REST_M, SampleTiming(MS))
    assert np.abs(np.linalg.eigvals(loop.linear().a)).max() < 1.0


def test_forces_in_balance_with_one_another_have_bounded_variances():
    """Two struts between the same bodies: of their forces only the sum is observable."""
    spec = load_model(MODELS / "reference.yaml")
    twin = spec.struts[0].model_copy(update={"name": "twin"})
    plant = DartPlant(spec.model_copy(update={"struts": (*spec.struts, twin)}))
    model = joint_of(linearise_at(plant, [0.4, 0.4]))
    assert np.all(np.isfinite(model.steady))
    assert np.diagonal(model.steady).max() < 1e10
    joint = JointFilter(model)
    state = joint.steady_state(0)
    for tick in range(1, 500):
        seen = [Innovation(1e-5, tick * MS)] * 2
        state = joint.step(state, tick * MS, seen, [[], []], [1e4] * len(joint.followed))
    assert all(math.isfinite(it.virtual_force_n) for it in state.struts)
    together = state.covariance_n2.sum()
    assert together < 1e-3 * np.diagonal(state.covariance_n2).sum()


def test_an_observer_of_another_kind_keeps_its_own_strut(car):
    """The published observer beside a joint filter: its state is its own."""
    observers = StrutObservers([observer("pi"), observer()])
    state = observers.init(starts_of(car), car, ObserversState())
    state = observers.step(state, MS, [Innovation(1e-4, MS), Innovation(0.0, MS)], [[], []])
    assert state.struts[0].virtual_force_n == pytest.approx(1e5 * 1e-4, rel=1e-3)
    numbers = observers.numbers(state)
    again = observers.with_numbers(state, numbers)
    assert [it.virtual_force_n for it in again.struts] == pytest.approx(
        [it.virtual_force_n for it in state.struts]
    )


@pytest.mark.parametrize("kinds", [("none", "none"), ("pi", "pi"), ("pi", "none")])
def test_without_a_noise_aware_observer_there_is_no_joint_filter(car, kinds):
    observers = StrutObservers([observer(kind) for kind in kinds])
    assert observers.init(starts_of(car), car, ObserversState()).joint is None


@pytest.mark.parametrize(
    ("quantity", "noise_std", "share"), [(FORCE, 0.01, 0.2), (VELOCITY, 1e-6, 0.85)]
)
def test_a_further_sensor_narrows_the_force_of_its_strut(car, quantity, noise_std, share):
    cell = Channel(4, Role.SENSOR, quantity, "cell", "", 1, MS, noise_std=noise_std)
    joint = JointFilter(joint_of(car, sensors=((), (cell,))))
    plain = JointFilter(joint_of(car))
    state, without = joint.steady_state(0), plain.steady_state(0)
    for tick in range(1, 300):
        seen = [Innovation(0.0, tick * MS)] * 2
        state = joint.step(
            state,
            tick * MS,
            seen,
            [[], [Innovation(0.0, tick * MS, 4)]],
            [1e4] * len(joint.followed),
        )
        without = plain.step(without, tick * MS, seen, [[], []], [1e4] * len(plain.followed))
    assert state.struts[1].force_std_n < share * without.struts[1].force_std_n


def test_another_force_limit_holds_from_the_next_tick_on(car):
    """A state of observers that differ in their limits alone continues."""
    wide, narrow = (
        StrutObservers([replace_limit(observer(), limit_n), observer("measured")])
        for limit_n in (1e4, 3.0)
    )
    state = wide.init(starts_of(car), car, ObserversState())
    for tick in range(1, 30):
        seen = [Innovation(1e-4, tick * MS), Innovation(0.0, tick * MS)]
        state = wide.step(state, tick * MS, seen, [[], []])
    assert abs(state.struts[0].virtual_force_n) > 3.0
    seen = [Innovation(1e-4, 30 * MS), Innovation(0.0, 30 * MS)]
    state = narrow.step(state, 30 * MS, seen, [[], []])
    assert max(abs(it.virtual_force_n) for it in state.struts) <= 3.0
    assert state.struts[0].is_disturbed


def replace_limit(made, limit_n):
    return dataclasses.replace(made, force_limit_n=limit_n)


@pytest.mark.parametrize("bandwidth_hz", [10.0, 60.0])
def test_a_height_that_is_measured_seldom_does_not_slow_down_the_others(car, bandwidth_hz):
    """A tyre's height every 20 ms below a suspension's every millisecond."""
    starts = starts_of(car)
    starts[0] = replace(starts[0], interval_ns=20 * MS)
    followed = [
        FollowedStrut(0, NOISE_M, None),
        FollowedStrut(1, NOISE_M, ErrorFilter(bandwidth_hz, NOISE_M)),
    ]
    seldom = JointFilter(JointModel(car, starts, followed))
    often = JointFilter(joint_of(car, ("measured", "kalman"), bandwidth_hz))
    stds = []
    for joint, every in ((seldom, 20), (often, 1)):
        rng, state = np.random.default_rng(4), joint.steady_state(0)
        for tick in range(1, 1501):
            t_ns = tick * MS
            noise = NOISE_M * rng.standard_normal(2)
            seen = [Innovation(value, t_ns) for value in noise.tolist()]
            seen[0] = seen[0] if tick % every == 0 else None
            state = joint.step(state, t_ns, seen, [[], []], [1e4] * 2)
            state = replace(state, inputs=((t_ns, np.zeros(2)),), used=())
        stds.append(state.struts[1].force_std_n)
    assert stds[1] < stds[0] < 3.0 * stds[1]


def test_an_unknown_deviation_stays_unknown_beside_a_joint_filter(car):
    observers = StrutObservers([observer("pi"), observer()])
    state = observers.init(starts_of(car), car, ObserversState())
    assert math.isnan(state.struts[0].force_std_n)
    assert math.isfinite(state.struts[1].force_std_n)


def test_a_filter_begins_with_its_own_heights(car):
    """Not with the tick at which the model starts, where a strut without a height begins."""
    starts = starts_of(car)
    starts[0] = replace(starts[0], t_ns=30 * MS, interval_ns=0)
    state = StrutObservers([observer("none"), observer()]).init(starts, car, ObserversState())
    assert state.joint.point.t_ns == starts[1].t_ns
