"""A corrected model of a bench whose base is moved, live: in lockstep with that bench over CAN.

The run is that of `rig run` with the configuration of the package: its observers are Kalman
filters, whose gains are computed from the model.
"""

import math
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from dart_model.spec import ModelSpec, dump_model
from rig.formats.run_arrays import open_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.schema import BenchConfig
from tests.diagnosis_benchmark.moving import (
    HELD_OUT_S,
    MovingCase,
    moved_otherwise,
    nominal_bench,
    nominal_model,
)

_CONFIGURATIONS = {
    "moving_shaker": "quarter_car_road",
    "moving_quarter_car": "quarter_car_road",
    "moving_posts": "four_post",
}
_SETTLED_S = 1.0
"""Time after which the virtual force counts."""
_FLOOR_SEED = 1


def live_force_of_moving(case: MovingCase, corrected: ModelSpec) -> float:
    """RMS virtual force of a corrected model on its bench, over that of a right model.

    The bench moves as in the held-out run. The floor is what the same observers find of
    the bench without any effect, with the model that lacks nothing: it is made by noise, and by
    holding values from tick to tick. Infinite where a force is not finite.
    """
    bench = moved_otherwise(case.bench, 2 * case.seed + 2)
    return _virtual_force_n(case.kind, bench, corrected) / _floor_n(case.kind)


@cache
def _floor_n(kind: str) -> float:
    bench = moved_otherwise(nominal_bench(kind), _FLOOR_SEED)
    return _virtual_force_n(kind, bench, nominal_model(kind))


def _virtual_force_n(kind: str, bench: BenchConfig, model: ModelSpec) -> float:
    """RMS of the virtual forces of all struts; they are zero without an observer."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "model.yaml").write_text(dump_model(model), encoding="utf-8")
        config = folder / "rig.yaml"
        config.write_text(yaml.safe_dump(_configuration(kind, folder, model)), encoding="utf-8")
        ended = with_bench(load_plan(config), bench, folder / "run", lockstep=True)
        run = open_run(ended.folder)
        forces_n = [
            values[run.t_s >= _SETTLED_S]
            for name, values in run.columns.items()
            if name.endswith(".virtual_force_n")
        ]
    mean = float(np.mean(np.square(forces_n)))
    return math.sqrt(mean) if math.isfinite(mean) else math.inf


def _configuration(kind: str, folder: Path, model: ModelSpec) -> dict:
    """The package's configuration for the struts of a model in a folder."""
    path = CONFIGS / f"{_CONFIGURATIONS[kind]}.yaml"
    config = yaml.safe_load(path.read_text(encoding="utf-8"))
    struts = {strut.name for strut in model.struts}
    of_struts = (config["signals"]["height"], config["observers"], config["publish"])
    for group in of_struts:
        for name in [name for name in group if name not in struts]:
            del group[name]
    if "dbc" in config:
        config["dbc"] = str(CONFIGS / config["dbc"])
    return config | {"model": str(folder / "model.yaml"), "duration_s": HELD_OUT_S}
