"""A replay in bulk gives what the bridge gave frame by frame, whatever came over the bus."""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.bridge.mode_supervisor import Supervision
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.replay import replay
from tests.run.listed import MS, ListPort, bench_frames, live

FAULTS = ("lost", "repeated", "flipped", "short", "late", "foreign", "error", "again", "silent")


def ready_for(ticks: int) -> Plan:
    """The reference case, whose estimate is valid 50 ms after its start: in every short run."""
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=ticks / 1000)
    supervision = ready.config.supervision.model_copy(update={"settling_s": 0.05})
    return ready.with_config(ready.config.model_copy(update={"supervision": supervision}))


@settings(max_examples=20, deadline=None)
@given(
    faults=st.dictionaries(st.integers(0, 299), st.sampled_from(FAULTS), max_size=30),
    acknowledged=st.sets(st.integers(0, 299), max_size=3),
)
def test_faults_of_every_kind_are_replayed_bit_by_bit(faults, acknowledged):
    ready = ready_for(300)
    port = ListPort(bench_frames(ready, 300, faults), acknowledged)
    with TemporaryDirectory() as name:
        live(ready, Path(name) / "run", port)
        found = replay(Path(name) / "run")
    assert found.logged == len(found.steps) == 300
    assert found.different == 0


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_changes_the_number_of_ticks(fault, tmp_path):
    ready = ready_for(200)
    faults = dict.fromkeys(range(50, 60), fault)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 200, faults), set()))
    found = replay(tmp_path / "run")
    assert found.steps.column("t_ns").to_pylist() == [k * MS for k in range(200)]
    assert found.different == 0


def test_a_safe_state_and_its_acknowledgement_are_replayed(tmp_path):
    ready = ready_for(1000)
    port = ListPort(bench_frames(ready, 1000, {100: "silent"}), {900})
    live(ready, tmp_path / "run", port)
    found = replay(tmp_path / "run")
    modes = found.steps.column("mode").to_pylist()
    assert set(modes) == {1, 2, 3, 4, 5}
    assert modes[-1] == 2
    assert found.different == 0


def test_refused_frames_are_counted_as_they_were_live(tmp_path):
    ready = ready_for(100)
    faults = {20: "flipped", 21: "flipped", 40: "short", 60: "repeated"}
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 100, faults), set()))
    assert replay(tmp_path / "run").refused_frames == 4


def test_the_default_supervision_is_what_these_tests_assume():
    supervision = load_plan(CONFIGS / "reference.yaml").config.supervision
    assert supervision == Supervision(stale_after_s=0.01, safe_after_s=0.5, safe_output="zero")
    assert ready_for(1).config.supervision == supervision.model_copy(update={"settling_s": 0.05})
