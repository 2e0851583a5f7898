"""Compiles what a diagnosis of the dyno's run needs, for a machine on which that takes minutes."""

import json
import random
import tempfile
from pathlib import Path

import numpy as np

from tests.sensors.dyno import read_sensors
from tests.sensors.story import MODEL, rig


def main() -> None:
    """Diagnose a record such as the dyno's."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        noise = random.Random(1)
        rows = [(t_s, *read_sensors(t_s, noise)) for t_s in np.arange(0.0, 10.0, 0.01)]
        text = "".join(
            f"{t_s:.3f},{height_m:.6f},{force_n:.3f}\n" for t_s, height_m, force_n in rows
        )
        record, model = folder / "record.csv", folder / "dyno.yaml"
        record.write_text("t_s,height_m,strut_force_n\n" + text)
        model.write_text(json.dumps(MODEL))
        rig("diagnose", record, "--model", model, "--out", folder / "out")


if __name__ == "__main__":
    main()
