"""A replay in bulk gives what the bridge gave frame by frame, whatever came over the bus."""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import Request
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.replay import replay
from tests.run.listed import MS, ListPort, bench_frames, live

FAULTS = ("lost", "repeated", "flipped", "short", "late", "foreign", "error", "again", "silent")


def ready_for(ticks: int, **changed: object) -> Plan:
    """The reference case, whose estimate is valid 50 ms after its start: in every short run."""
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=ticks / 1000)
    supervision = ready.config.supervision.model_copy(update={"settling_s": 0.05, **changed})
    return ready.with_config(ready.config.model_copy(update={"supervision": supervision}))


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(
    faults=st.dictionaries(st.integers(0, 299), st.sampled_from(FAULTS), max_size=30),
    requests=st.dictionaries(st.integers(0, 299), st.sampled_from(Request), max_size=6),
    arming=st.sampled_from(["automatic", "manual"]),
    fade_in_s=st.sampled_from([0.0, 0.02]),
    slew_n_per_s=st.sampled_from([None, 3000.0]),
)
def test_faults_of_every_kind_are_replayed_bit_by_bit(
    faults, requests, arming, fade_in_s, slew_n_per_s
):
    ready = ready_for(300, arming=arming, fade_in_s=fade_in_s, slew_n_per_s=slew_n_per_s)
    port = ListPort(bench_frames(ready, 300, faults), requests)
    with TemporaryDirectory() as name:
        live(ready, Path(name) / "run", port)
        found = replay(Path(name) / "run")
    assert found.logged == len(found.steps) == 300
    assert found.different == 0


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_changes_the_number_of_ticks(fault, tmp_path):
    ready = ready_for(200)
    faults = dict.fromkeys(range(50, 60), fault)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 200, faults)))
    found = replay(tmp_path / "run")
    assert found.steps.column("t_ns").to_pylist() == [k * MS for k in range(200)]
    assert found.different == 0


def test_a_safe_state_and_its_acknowledgement_are_replayed(tmp_path):
    ready = ready_for(1000)
    port = ListPort(bench_frames(ready, 1000, {100: "silent"}), {900: Request.ACKNOWLEDGE})
    live(ready, tmp_path / "run", port)
    found = replay(tmp_path / "run")
    modes = found.steps.column("mode").to_pylist()
    assert set(modes) == {1, 2, 3, 4, 5}
    assert modes[-1] == 2
    assert found.different == 0


def test_a_bridge_armed_by_hand_is_replayed(tmp_path):
    ready = ready_for(300, arming="manual")
    requests = {100: Request.ARM, 200: Request.DISARM, 250: Request.ARM}
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 300, {}), requests))
    found = replay(tmp_path / "run")
    modes = found.steps.column("mode").to_pylist()
    assert [modes[tick] for tick in (99, 100, 199, 200, 249, 250)] == [6, 2, 2, 6, 6, 2]
    assert found.different == 0


def test_refused_frames_are_counted_as_they_were_live(tmp_path):
    ready = ready_for(100)
    faults = {20: "flipped", 21: "flipped", 40: "short", 60: "repeated"}
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 100, faults)))
    assert replay(tmp_path / "run").refused_frames == 4


def test_the_default_supervision_is_what_these_tests_assume():
    supervision = load_plan(CONFIGS / "reference.yaml").config.supervision
    assert supervision == Supervision(stale_after_s=0.01, safe_after_s=0.5, safe_output="zero")
    assert ready_for(1).config.supervision == supervision.model_copy(update={"settling_s": 0.05})
