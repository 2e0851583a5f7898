"""Limits of each strut: those of a configuration, and those that follow from the DBC."""

import dataclasses
from pathlib import Path

import pytest
from msgspec.structs import replace
from pydantic import ValidationError

from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.errors import InputError
from rig.bridge.estimator import Estimate
from rig.bridge.mode_supervisor import Supervisor
from rig.bridge.supervision_limits import Limit, LimitedValue
from rig.bridge.values import Mode, StepInput
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import APPLIED_FORCE, HEIGHT, LOAD_CELL_FORCE
from rig.plan.limits import resolve_limits
from tests.bridge.test_modes import MS, STRUT, SUPERVISION, Scripted

SOURCE = Path("rig.yaml")
DATABASE = load_database(DEFAULT_DATABASE)
MESSAGE = DATABASE.message("BENCH_MEASUREMENT")


def height(strut=0, message=MESSAGE):
    return Channel(strut, Role.HEIGHT, HEIGHT, "", "", strut, 1, message=message, signal="HEIGHT")


def row(**keys):
    return Limit(**{"low": None, "high": None, "action": "hold"} | keys)


def with_range(low, high):
    """The measurement with another range in the DBC."""
    signal = dataclasses.replace(MESSAGE.signal("HEIGHT"), minimum=low, maximum=high)
    return dataclasses.replace(MESSAGE, signals={**MESSAGE.signals, "HEIGHT": signal})


def resolved(configured=(), struts=("strut",), heights=None, forces=None, can_compare=False):
    heights = [height()] if heights is None else heights
    return resolve_limits(
        configured, struts, heights, forces or {}, SOURCE, can_compare=can_compare
    ).struts


def test_the_bits_limit_what_the_range_does_not():
    ((model,),) = resolved()
    assert (model.value, model.action) == (LimitedValue.HEIGHT_M, "safe")
    # 20 bits of 2 um, and a tenth of them on both sides.
    assert model.high - model.low == pytest.approx(1.2 * 2e-6 * (2**20 - 1))


@pytest.mark.parametrize(
    ("bounds", "text"),
    [({"low": 0.61}, r"0\.low: 0\.61"), ({"high": 0.09}, r"0\.high: 0\.09")],
)
def test_a_limit_that_no_height_is_within_is_one_line(bounds, text):
    measured = row(value="measured_height_m", **bounds)
    with pytest.raises(InputError, match=text + ", expected .* HEIGHT can have, 0.1 to 0.6 in SI"):
        resolved([measured], heights=[height(message=with_range(0.1, 0.6))])
    # One of another strut, or that a height may be within, is none of its concern.
    resolved([row(value="measured_height_m", low=0.6)], heights=[height()])


@pytest.mark.parametrize(
    "bounds", [{"high": 0.0}, {"high": -1.0}, {"low": 0.1}, {"low": 0.1, "high": 1.0}]
)
def test_a_time_without_a_change_has_a_highest_value_alone(bounds):
    with pytest.raises(
        ValidationError, match="unchanged_s: expected high, more than 0, and no low"
    ):
        row(value="unchanged_s", **bounds)


def test_a_height_beyond_the_dbcs_range_is_refused():
    ((measured, model),) = resolved(heights=[height(message=with_range(0.1, 0.6))])
    assert (measured.value, measured.action) == (LimitedValue.MEASURED_HEIGHT_M, "refuse")
    assert measured.action_at(0.1) == measured.action_at(0.6) == 0
    assert measured.action_at(0.0999)
    assert measured.action_at(0.6001)
    assert (model.low, model.high) == (pytest.approx(0.05), pytest.approx(0.65))


def test_a_force_that_its_signal_cannot_carry_is_invalid():
    forces = {0: (DATABASE.message("RIG_ESTIMATE"), "SPRING_DAMPER_FORCE")}
    ((_, force),) = resolved(forces=forces)
    assert (force.value, force.action) == (LimitedValue.FORCE_N, "hold")
    assert (force.low, force.high) == (-40_000.0, 40_000.0)


def test_a_row_of_the_configuration_replaces_what_would_follow_for_its_value():
    own = row(value="height_m", low=0.0, high=1.0)
    assert resolved([own]) == ((own,),)


def test_a_row_with_a_strut_is_for_that_strut_alone():
    own = row(strut="rear", value="height_m", low=0.0, high=1.0)
    every = row(value="force_n", high=100.0)
    front, rear = resolved([own, every], ("front", "rear"), [height(0), height(1)])
    assert front[0] is every
    assert [item.value for item in front] == [LimitedValue.FORCE_N, LimitedValue.HEIGHT_M]
    assert front[1].action == "safe"
    assert rear == (own, every)


def test_a_row_of_a_strut_that_is_not_there_is_one_line():
    own = row(strut="front", value="force_n", high=100.0)
    with pytest.raises(InputError, match=r"limits\.0\.strut: front: no such strut, expected strut"):
        resolved([own])


def test_a_difference_from_a_load_cell_needs_one_and_its_strut():
    own = row(value="force_difference_n", high=100.0)
    with pytest.raises(InputError, match=r"limits\.0\.value: force_difference_n: expected signals"):
        resolved([own])
    assert resolved([own], can_compare=True)[0][0] is own
    with pytest.raises(InputError, match=r"limits\.0\.strut: expected the strut .* front, rear"):
        resolved([own], ("front", "rear"), can_compare=True)
    named = row(value="force_difference_n", high=100.0, strut="rear")
    assert named in resolved([named], ("front", "rear"), can_compare=True)[1]


def test_a_limit_on_a_standard_deviation_needs_an_observer_that_knows_it():
    own = row(value="force_std_n", high=100.0)
    assert own in resolved([own])[0]

    def of_two(limit):
        return resolve_limits(
            [limit],
            ("front", "rear"),
            (height(0), height(1)),
            {},
            SOURCE,
            can_compare=False,
            without_std=["rear"],
        ).struts

    with pytest.raises(InputError, match=r"0\.value: force_std_n: observers\.rear does not"):
        of_two(own)
    front = row(value="force_std_n", high=100.0, strut="front")
    assert front in of_two(front)[0]


def test_a_strut_without_a_height_has_no_limit_of_it():
    assert resolved(heights=[]) == ((),)


def test_the_estimate_of_a_strut_is_judged_by_its_own_limits():
    estimator = Scripted()
    estimator.struts = 2
    limits = [[row(value="force_n", high=10.0)], [row(value="force_n", high=4.0)]]
    supervisor = Supervisor(estimator, SUPERVISION, limits)
    state = supervisor.init(0)
    for force_n, expected in ((3.0, Mode.RUNNING), (5.0, Mode.HOLD)):
        struts = (STRUT, STRUT) if force_n == STRUT.force_n else (STRUT, replace(STRUT, force_n=3))
        estimator.estimate = Estimate(struts, state.t_ns + MS, True)
        state, output, _ = supervisor.step(state, StepInput(state.t_ns + MS))
        assert output.mode is expected
    cause = state.cause
    assert (cause.strut, cause.value, cause.limit) == (1, 5.0, 4.0)


FORCE = Channel(
    1,
    Role.INPUT,
    APPLIED_FORCE,
    "applied_force",
    "",
    -1,
    1,
    message=MESSAGE,
    signal="APPLIED_FORCE",
)
CELL = Channel(
    1,
    Role.BENCH,
    LOAD_CELL_FORCE,
    "load_cell_force",
    "",
    -1,
    1,
    message=DATABASE.message("BENCH_AUXILIARY"),
    signal="LOAD_CELL_FORCE",
)


DRIVEN = (height(), FORCE)


def of_channels(configured=(), channels=DRIVEN):
    return resolve_limits(configured, ("strut",), channels, {}, SOURCE, can_compare=False).channels


def test_what_a_height_measures_has_the_limits_of_its_strut():
    own = row(value="measured_height_m", high=1.0, action="refuse")
    of_height, _ = of_channels([own, row(value="force_n", high=1.0)])
    assert of_height == (own,)


def test_an_applied_force_beyond_the_dbcs_range_is_refused():
    _, (limit,) = of_channels()
    assert (limit.channel, limit.value, limit.action) == (
        "applied_force",
        LimitedValue.MEASURED,
        "refuse",
    )
    assert (limit.low, limit.high) == (pytest.approx(-5000.005), pytest.approx(5000.005))


def test_what_no_estimate_rests_on_has_no_limit_by_itself():
    assert of_channels(channels=(height(), CELL))[1] == ()
    own = row(channel="load_cell_force", value="measured", high=10.0, action="warn")
    assert of_channels([own], (height(), CELL))[1] == (own,)


def test_a_row_for_a_channel_replaces_what_would_follow_and_is_no_struts():
    own = row(channel="applied_force", value="measured", high=10.0, action="safe")
    stuck = row(channel="applied_force", value="unchanged_s", high=1.0)
    of_height, of_force = of_channels([own, stuck])
    assert (of_height, of_force) == ((), (own, stuck))


def test_a_row_for_a_channel_that_is_not_measured_is_one_line():
    for name in ("strut", "temperature"):
        own = row(channel=name, value="measured", high=10.0)
        with pytest.raises(
            InputError, match=rf"0\.channel: {name}: not measured, .* applied_force"
        ):
            of_channels([own])


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"channel": "applied_force", "value": "force_n"}, "expected one of measured, measured_ra"),
        ({"channel": "applied_force", "value": "measured_height_m"}, "expected one of measured,"),
        ({"channel": "a", "strut": "b", "value": "measured"}, "and no strut"),
        ({"value": "measured"}, "expected the key channel"),
        ({"value": "measured_rate_per_s"}, "expected the key channel"),
    ],
)
def test_a_limit_is_of_a_strut_or_of_a_channel(keys, text):
    with pytest.raises(ValidationError, match=text):
        row(high=1.0, **keys)
