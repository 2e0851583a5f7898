"""A run whose frames waited on the bus is diagnosed as one whose frames did not."""

import pytest

from rig.demo.story import STORIES, build_bench, draw_effect
from rig.diagnosis.diagnose import diagnose
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.recordings.read import read_recording
from rig.run.live import with_bench

HALF_A_CYCLE_NS = 500_000


def diagnose_run(seed, jitter_ns, folder):
    """The diagnosis of a run of the story's bench, whose frames wait up to a time."""
    effect = draw_effect(seed)[1]
    plan = load_plan(CONFIGS / "story.yaml", duration_s=12.0)
    recordings = []
    for excitation in (2 * seed + 1, 2 * seed + 2):
        bench = build_bench(STORIES["story"], effect, excitation)
        sent = tuple(it.model_copy(update={"jitter_ns": jitter_ns}) for it in bench.transmissions)
        out = folder / f"{jitter_ns}-{excitation}"
        with_bench(plan, bench.model_copy(update={"transmissions": sent}), out, lockstep=True)
        recordings.append(read_recording(out))
    return diagnose(plan.model, recordings[:1], recordings[1:]).diagnosis


def assert_alike(one, other):
    assert one.verdict == other.verdict
    assert [effect.name for effect in one.effects] == [effect.name for effect in other.effects]
    assert one.channels == other.channels == ()
    for a, b in zip(one.effects, other.effects, strict=True):
        for name, value in a.parameters.items():
            if value.low is not None and b.parameters[name].low is not None:
                assert value.low <= b.parameters[name].value <= value.high
                assert b.parameters[name].low <= value.value <= b.parameters[name].high


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(0, marks=pytest.mark.slow),
        *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 20)),
    ],
)
def test_frames_that_wait_up_to_half_a_cycle_change_no_name_and_no_value(seed, tmp_path):
    at_once, late = (diagnose_run(seed, jitter_ns, tmp_path) for jitter_ns in (0, HALF_A_CYCLE_NS))
    assert_alike(at_once, late)
