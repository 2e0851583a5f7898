"""Figures of measured dampers against means by phase that are computed here."""

from pathlib import Path

import numpy as np
import pytest

from rig.dyno.characterise import characterise_record
from rig.dyno.figures import ForceRecord

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
RECORDS = [
    *sorted((DATA / "mr_damper").glob("*.txt")),
    *sorted((DATA / "brfd").glob("*.csv")),
]
PARTS = 180

pytestmark = pytest.mark.skipif(not RECORDS, reason="no measured data beside the checkout")


def read(path):
    """Times, heights, and forces that are positive when the strut pushes."""
    if path.suffix == ".txt":
        t_s, x_mm, _, force_n = np.genfromtxt(path, skip_header=1, unpack=True)
        return t_s, 0.5 + 1e-3 * x_mm, -force_n
    rows = np.genfromtxt(path, delimiter=",", names=True)
    return rows["t_s"], rows["height_m"], rows["strut_force_n"]


def by_phase(t_s, height_m, force_n, frequency_hz):
    """Mean force over the phase of the height's first harmonic, and how many cycles are in it."""
    angle = 2.0 * np.pi * frequency_hz * t_s
    made = np.column_stack([np.sin(angle), np.cos(angle), np.ones_like(angle)])
    sine, cosine, _ = np.linalg.lstsq(made, height_m, rcond=None)[0]
    phase = np.mod(angle + np.arctan2(cosine, sine), 2.0 * np.pi)
    part = (phase / (2.0 * np.pi) * PARTS).astype(int)
    counts = np.bincount(part, minlength=PARTS)
    return np.bincount(part, force_n, PARTS) / np.maximum(counts, 1), counts


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.name)
def test_peaks_and_energy_are_those_of_the_means_by_phase(path):
    t_s, height_m, force_n = read(path)
    found = characterise_record(ForceRecord(path.name, t_s, height_m, force_n))
    assert found.corrections.removed_lag_s == 0.0  # one step does not tell a lag from memory
    for step in found.steps:
        if step.frequency_hz is None:
            continue
        here = (t_s >= step.begin_s) & (t_s <= step.end_s)
        here = np.flatnonzero(here)[
            : round(step.cycles / step.frequency_hz / np.median(np.diff(t_s)))
        ]
        mean_n, counts = by_phase(t_s[here], height_m[here], force_n[here], step.frequency_hz)
        if counts.min() < 2:
            continue
        # Parts of two degrees as well, of another phase.
        for figure, peak_n in (
            (step.compression.peak_of_cycles_n, mean_n.max()),
            (step.rebound.peak_of_cycles_n, mean_n.min()),
        ):
            wide_n = 0.5 * (figure.high - figure.low) + 0.03 * abs(peak_n)
            assert abs(figure.value - peak_n) <= wide_n
        # The work of whole cycles, of the samples as they are.
        whole = here[: int(int(step.cycles) / step.frequency_hz / np.median(np.diff(t_s))) + 1]
        energy_j = -np.trapezoid(force_n[whole], height_m[whole]) / int(step.cycles)
        figure = step.energy_per_cycle_j
        wide_j = 0.5 * (figure.high - figure.low) + 0.03 * energy_j
        assert abs(figure.value - energy_j) <= wide_j
