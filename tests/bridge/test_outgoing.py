"""Outgoing messages: when they are sent and what they carry, by another program's codec."""

from itertools import pairwise

import cantools.database
import pytest

from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.bridge.counts import Conditions, Report
from rig.bridge.outgoing_messages import PublishedSignal, compile_outgoing
from rig.bridge.published_quantities import COUNTER
from rig.bridge.values import Mode, StrutOutput
from tests.faults.trial import MS, Trial

DBC = cantools.database.load_file(DEFAULT_DATABASE)


@pytest.fixture(scope="module")
def ticks():
    return Trial().run(2100)


def sent(ticks, name):
    message = DBC.get_message_by_name(name)
    return [
        (frame.t_ns, message.decode(frame.data, decode_choices=False))
        for tick in ticks
        for frame in tick.result.frames
        if frame.arbitration_id == message.frame_id
    ]


@pytest.mark.parametrize("name", ["RIG_ESTIMATE", "RIG_KINEMATICS", "RIG_STATUS", "RIG_TIMING"])
def test_each_message_is_sent_at_its_cycle_time(ticks, name):
    cycle_ns = DBC.get_message_by_name(name).cycle_time * MS
    times = [t_ns for t_ns, _ in sent(ticks, name)]
    assert len(times) >= 2100 * MS // cycle_ns
    assert {b - a for a, b in pairwise(times)} == {cycle_ns}


def test_counters_go_up_by_one(ticks):
    for name in ("RIG_ESTIMATE", "RIG_STATUS"):
        counters = [values["COUNTER"] for _, values in sent(ticks, name)]
        assert {(b - a) % 16 for a, b in pairwise(counters)} == {1}


def test_a_counter_without_protection_goes_round_its_range(tmp_path):
    lines = [
        'VERSION ""', "BS_:", "BU_: BENCH RIG",
        "BO_ 256 ESTIMATE: 8 RIG",
        ' SG_ FORCE : 0|16@1- (1,0) [-32768|32767] "N" BENCH',
        ' SG_ COUNT : 16|4@1+ (1,0) [0|15] "" BENCH',
    ]  # fmt: skip
    (tmp_path / "own.dbc").write_text("\n".join(lines) + "\n")
    message = load_database(tmp_path / "own.dbc").message("ESTIMATE")
    outgoing = compile_outgoing(message, [PublishedSignal("COUNT", COUNTER)])
    tick = Trial().run(1)[0]
    counts = []
    for number in range(40):
        report = Report(tick.result.output, tick.counts, tick.counts, Conditions(), number)
        frame, saturated = outgoing.frame(report, 0)
        assert not saturated
        counts.append(frame.data[2] & 0x0F)
    assert counts == [number % 16 for number in range(40)]


def test_what_is_sent_is_what_the_core_published(ticks):
    nothing = StrutOutput(0.0, 0.0, False, 0.0, 0.0, 0.0, 0.0)
    by_time = {tick.t_ns: (*tick.result.output.struts, nothing)[0] for tick in ticks}
    valid = {by_time[t_ns].valid for t_ns, _ in sent(ticks, "RIG_ESTIMATE")}
    assert valid == {False, True}
    for t_ns, values in sent(ticks, "RIG_ESTIMATE"):
        strut = by_time[t_ns]
        assert values["SPRING_DAMPER_FORCE"] == pytest.approx(strut.force_n, abs=0.0026)
        assert values["VIRTUAL_FORCE"] == pytest.approx(strut.virtual_force_n, abs=0.0026)
        assert values["VALID"] == strut.valid
    for t_ns, values in sent(ticks, "RIG_KINEMATICS"):
        strut = by_time[t_ns]
        assert values["MODEL_HEIGHT"] == pytest.approx(strut.height_m, abs=1.7e-5)
        assert values["MODEL_VELOCITY"] == pytest.approx(strut.velocity_m_per_s, abs=1.1e-3)
        assert values["MODEL_ACCELERATION"] == pytest.approx(strut.acceleration_m_per_s2, abs=0.06)
        assert values["INNOVATION"] == pytest.approx(strut.innovation_m, abs=2.6e-6)


def test_every_message_is_sent_from_the_first_tick_on_and_says_in_what_mode(ticks):
    """Zeros and invalid while there is no model; invalid until its estimate has settled."""
    assert {tick.mode for tick in ticks} == {Mode.WAITING, Mode.SETTLING, Mode.RUNNING}
    modes = {tick.t_ns: tick.mode for tick in ticks}
    for t_ns, values in sent(ticks, "RIG_ESTIMATE"):
        assert values["VALID"] == (modes[t_ns] is Mode.RUNNING)
        if modes[t_ns] is Mode.WAITING:
            assert values["SPRING_DAMPER_FORCE"] == values["VIRTUAL_FORCE"] == 0.0
    for t_ns, values in sent(ticks, "RIG_STATUS"):
        assert values["STATE"] == modes[t_ns]
    for name in ("RIG_ESTIMATE", "RIG_KINEMATICS", "RIG_STATUS", "RIG_TIMING"):
        assert sent(ticks, name)[0][0] == 0
