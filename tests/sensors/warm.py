"""Compiles what a diagnosis of the dyno's run needs, for a machine on which that takes minutes."""

import json
import tempfile
from pathlib import Path

import numpy as np

from tests.sensors.dyno import force_n, motion
from tests.sensors.story import MODEL, rig


def main() -> None:
    """Diagnose a record such as the dyno's."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [(t_s, *motion(t_s)) for t_s in np.arange(0.0, 10.0, 0.01)]
        text = "".join(
            f"{t_s:.3f},{height_m:.6f},{force_n(height_m, velocity):.3f}\n"
            for t_s, height_m, velocity in rows
        )
        record, model = folder / "record.csv", folder / "dyno.yaml"
        record.write_text("t_s,height_m,strut_force_n\n" + text)
        model.write_text(json.dumps(MODEL))
        rig("diagnose", record, "--model", model, "--out", folder / "out")


if __name__ == "__main__":
    main()
