"""How well the rate was kept, as the bus is told of it."""

import cantools.database
import pytest

from can_dbc.database import DEFAULT_DATABASE
from rig.bridge.counts import Conditions, TimingFigures
from tests.faults.trial import Trial

TIMING = 0x310
LATENESS_S = (12e-6, 250e-6, 1.5e-3, 0.4)
WORK_S = (40e-6, 90e-6, 120e-6, 800e-6)


@pytest.fixture(scope="module")
def told():
    """What four seconds of timing frames say, decoded by another program's codec."""
    kept = TimingFigures(LATENESS_S, WORK_S, 0.401)
    trial = Trial()
    ticks = trial.run(4000, conditions=lambda t_ns: Conditions(overruns=t_ns == 0, timing=kept))
    message = cantools.database.load_file(DEFAULT_DATABASE).get_message_by_frame_id(TIMING)
    sent = [frame for tick in ticks for frame in tick.result.frames]
    return [
        (frame.t_ns, message.decode(frame.data)) for frame in sent if frame.arbitration_id == TIMING
    ]


def levels(frame, what):
    return [frame[f"{what}_{level}"] for level in ("P50", "P99", "P99_9", "MAX")]


def test_pages_come_in_turn_once_a_second(told):
    assert [str(frame["PAGE"]) for _, frame in told] == ["LATENESS", "WORK", "PACE", "LATENESS"]
    assert [frame["COUNTER"] for _, frame in told] == [0, 1, 2, 3]
    times_ns = [t_ns for t_ns, _ in told]
    assert [t_ns // 1_000_000_000 for t_ns in times_ns] == [0, 1, 2, 3]


def test_figures_are_those_of_the_loop_and_stop_at_the_end_of_their_range(told):
    lateness, work, pace, _ = [frame for _, frame in told]
    assert levels(lateness, "LATENESS") == pytest.approx([*LATENESS_S[:3], 0.016383], abs=0.5e-6)
    assert levels(work, "WORK") == pytest.approx(WORK_S, abs=0.5e-6)
    assert pace["LONGEST_GAP"] == pytest.approx(0.401, abs=0.5e-6)
    assert pace["OVERRUNS"] == 1


def test_a_figure_beyond_its_range_is_no_saturation():
    trial = Trial()
    trial.run(1500, conditions=lambda _t_ns: Conditions(timing=TimingFigures(longest_gap_s=1e3)))
    assert trial.state.counts.saturated == 0
