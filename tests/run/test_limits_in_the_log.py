"""What the log of a run has of a limit that only warns."""

import pyarrow as pa

from rig.log.step_columns import LIMITED
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.replay import replay
from tests.run.listed import ListPort, bench_frames, live

WARNED = {"value": "height_m", "high": 0.4, "action": "warn"}


def test_ticks_beyond_a_limit_are_marked_and_replayed(tmp_path):
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.4)
    content = ready.config.model_dump(mode="json")
    content["supervision"]["limits"] = [WARNED]
    ready = ready.with_config(ready.config.model_validate(content))
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 400, {})))
    with pa.memory_map(str(tmp_path / "run" / "steps.arrow")) as source:
        steps = pa.ipc.open_stream(source).read_all()
    flags = steps["flags"].to_numpy()
    height_m = steps["strut.height_m"].to_numpy()
    assert ((flags & LIMITED) != 0).tolist() == (height_m > 0.4).tolist()
    assert (flags & LIMITED).any()
    assert replay(tmp_path / "run").different == 0
