"""Writes a case as the files that a user would have: model, runs; and the truth apart."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml

from tests.truth.plant import Case, Recording
from tests.truth.simulation import (
    effect_force_rms_n,
    floor_ratios,
    force_noise_floor_n,
    simulate,
)


def write_case(case: Case, folder: Path) -> tuple[Recording, Recording]:
    """Write ``model.yaml``, ``train.csv``, ``test.csv`` and ``truth.json`` into a folder.

    Returns:
        The two recordings, as `simulate` gives them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    train, held_out = simulate(case)
    (folder / "model.yaml").write_text(model_yaml(case), encoding="utf-8")
    write_csv(train, folder / "train.csv")
    write_csv(held_out, folder / "test.csv")
    truth = truth_of(case, train)
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return train, held_out


def model_yaml(case: Case) -> str:
    """The model that lacks the effects, and is as rough as the case has it."""
    bench = case.nominal
    body = {
        "name": "body",
        "mass_kg": round(bench.mass_kg, 6),
        "joint": {"type": "prismatic", "axis": [0, 0, 1], "parent": "world"},
    }
    strut = {
        "name": "strut",
        "between": ["world", "body"],
        "free_length_m": round(bench.free_length_m, 6),
        "stiffness_n_per_m": round(bench.stiffness_n_per_m, 6),
        "damping_n_s_per_m": round(bench.damping_n_s_per_m, 6),
        "effects": [],
    }
    model = {
        "name": "bench",
        "gravity_m_per_s2": bench.gravity_m_per_s2,
        "skeleton": {"bodies": [body]},
        "struts": [strut],
    }
    return yaml.safe_dump(model, sort_keys=False)


def write_csv(recording: Recording, path: Path) -> None:
    """Write what the bench's sensors gave, units in the header."""
    columns = {
        "t_s": (recording.t_s, "%.6f"),
        "height_m": (recording.height_m, "%.6f"),
        "applied_force_n": (recording.applied_force_n, "%.2f"),
        "strut_force_n": (recording.strut_force_n, "%.2f"),
        "temperature_c": (recording.temperature_c, "%.2f"),
    }
    columns = {name: column for name, column in columns.items() if column[0] is not None}
    np.savetxt(
        path,
        np.column_stack([values for values, _ in columns.values()]),
        fmt=[form for _, form in columns.values()],
        delimiter=",",
        header=",".join(columns),
        comments="",
    )


def truth_of(case: Case, train: Recording) -> dict[str, object]:
    """The truth as plain data: the case, and how visible each effect is."""
    return asdict(case) | {
        "effect_force_rms_n": effect_force_rms_n(train).tolist(),
        "force_noise_floor_n": force_noise_floor_n(case),
        "floor_ratios": floor_ratios(case, train).tolist(),
    }
