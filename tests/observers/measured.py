"""Observers on measured data: `python -m tests.observers.measured DATA`.

EMPS: a carriage whose model has mass and viscous damping, without its friction. What is estimated
is the force beside the applied one; nobody measured it, so it is held against the force smoothed
over the whole record. MR damper: a dyno's record made a free body's: the applied force is what
100 kg at the measured motion, smoothed, would need beside the measured damper force; the observers
are given that force and the raw displacement, and their force is held against the load cell's.
"""

import argparse
from pathlib import Path

import numpy as np

from dart_model.plant import DartPlant
from dart_model.spec import parse_model
from rig.bridge.values import Mode
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.strut_response import linearise_at
from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import paper_observer
from rig.tuning.expectation import Expectation, longest_stretch, residual_force, spectrum
from rig.tuning.gains import Aim, TuningProblem, tune_observer
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.observers.benches import STRUT, follow

KINDS = ("published", "pi", "kalman", "smoothed")
LOST = 2.0
"""An estimate that errs by twice the force's deviation is none."""

TEXT = """
The observers follow measured records, and the estimated force is compared with a reference force.

- EMPS is a positioning stage without a spring. Its model has mass and viscous damping, but not the
  dry friction. The friction force was not measured: the reference is the force
  [smoothed after the run](../explanation/observers.md#smoothing-after-the-run).
- The MR (magnetorheological) damper was measured on a dyno with a load cell. The name of a record
  contains amplitude, frequency and current (`0x5` is 0.5). From the record, a bench without
  gravity is constructed in which the damper carries a body of 100 kg: the applied force is the
  force that gives this body the smoothed motion against the measured force of the damper. The model
  is the body alone, without a damper law. The observer uses the applied force and the unsmoothed
  displacement; the reference is the load cell.

An error is the RMS error relative to the standard deviation of the reference force. The noise is
the standard deviation of the noise in the measured height. A first pass with an untuned noise-aware
observer determines the longest section in which its estimate is always valid; the error of each
observer is evaluated at its valid ticks in this section, without the first 0.5 s of the section.
The share of valid ticks is in parentheses if it is below 100 %. `lost` stands for an error of
more than twice the standard deviation. The observers are tuned on the record on which they are
evaluated; the published gains are scaled with the mass.
"""

MODEL = """
name: measured
gravity_m_per_s2: 0.0
skeleton:
  bodies:
    - {{name: body, mass_kg: {mass}, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: {rest}
    stiffness_n_per_m: {stiffness}
    damping_n_s_per_m: {damping}
"""


class Record:
    """A record as `follow` takes it."""

    def __init__(self, t_s, height_m, applied_n, mass, stiffness, damping):
        self.period_ns = round(1e9 * (t_s[-1] - t_s[0]) / (len(t_s) - 1))
        self.height_m, self.applied_n, self.rest_m = height_m, applied_n, float(height_m[0])
        text = MODEL.format(mass=mass, rest=self.rest_m, stiffness=stiffness, damping=damping)
        self.plant = DartPlant(parse_model(text, "measured"))


def compare(name, record, force_n=None):
    """Errors of the published gains, the tuned PI, the noise-aware observer; a row of the page."""
    answers = linearise_at(record.plant, [record.rest_m]).responses()
    [(mobility, *_)] = answers
    corner_hz = 0.1 / (record.period_ns * 1e-9) / 6.2832
    start = KalmanObserver("kalman", ErrorFilter(bandwidth_hz=corner_hz, noise_std_m=1e-5), 1e6)
    seen = longest_stretch(
        follow(record, record.height_m, start), Path(name), STRUT, {STRUT: mobility}
    )
    noise_std_m, residual_n = residual_force(seen, mobility)
    smoothed = np.interp(seen.tick_s, seen.t_s, residual_n) + seen.law_force_n
    # The stretch may end, and begin again, where the bench suddenly moves more.
    first = round(1e9 * seen.tick_s[0] / record.period_ns)
    truth = smoothed if force_n is None else force_n[first : first + len(smoothed)]
    expectation = Expectation(noise_std_m, *spectrum(seen.t_s, residual_n), name)
    timing = SampleTiming(record.period_ns)
    bench = TuningProblem(
        record.plant, (start,), 0, answers, [record.rest_m], timing, expectation, 1e6
    )
    settled = round(0.5e9 / record.period_ns)
    deviation = np.std(truth[settled:])
    errors, valid = {}, {}
    for kind, observer in (
        ("published", paper_observer(bench.mobility_per_kg, bench.force_limit_n)),
        *((kind, tune_observer(bench, kind, Aim()).observer) for kind in ("pi", "kalman")),
    ):
        steps = follow(record, record.height_m, observer)[first : first + len(truth)][settled:]
        is_valid = steps.column("mode").to_numpy() == Mode.RUNNING
        missed = steps.column(f"{STRUT}.force_n").to_numpy() - truth[settled:]
        errors[kind] = np.sqrt(np.mean(missed[is_valid] ** 2)) / deviation
        valid[kind] = np.mean(is_valid)
    if force_n is not None:
        missed = (smoothed - truth)[settled:]
        errors["smoothed"] = np.sqrt(np.mean(missed**2)) / deviation
    figures = [
        f"{kind} {100 * error:.1f} % ({100 * valid.get(kind, 1.0):.1f} % valid)"
        for kind, error in errors.items()
    ]
    print(
        f"{name}: noise {1e6 * noise_std_m:.2g} um, {', '.join(figures)} of the force's deviation "
        f"{deviation:.3g} N",
        flush=True,
    )
    return (
        name,
        "the smoothed force" if force_n is None else "the load cell",
        f"{1e6 * noise_std_m:.2g}",
        f"{deviation:.4g}",
        *(_cell(errors.get(kind), valid.get(kind, 1.0)) for kind in KINDS),
    )


def _cell(error, valid):
    if error is None:
        return ""
    if error > LOST:
        return "lost"
    return f"{100 * error:.2g} %" + (f" ({100 * valid:.1f} % valid)" if valid < 0.9995 else "")


def emps(folder, name):
    t_s, height_m, applied_n = np.loadtxt(folder / name, delimiter=",", skiprows=1).T[:3]
    return compare(f"EMPS {name}", Record(t_s, height_m, applied_n, 95.1, 0.0001, 203.5))


def mr_damper(path, mass=100.0):
    t_s, displacement_mm, _, force_n = np.loadtxt(path).T[:4]
    t_s = np.linspace(t_s[0], t_s[-1], len(t_s))
    height_m = 0.5 + 1e-3 * displacement_mm
    states = smooth(t_s, height_m, estimate_noise(t_s, height_m)).states
    sign = -np.sign(np.sum(states[:, 1] * force_n))  # a damper's force is against its motion
    applied_n = mass * states[:, 2] - sign * force_n
    record = Record(t_s - t_s[0], height_m, applied_n, mass, 0.0001, 0.0001)
    return compare(f"MR damper {path.stem}", record, sign * force_n)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with emps and mr_damper")
    add_page_option(parser)
    given = parser.parse_args()
    rows = [emps(given.data / "emps", name) for name in ("train.csv", "pulses.csv")]
    paths = sorted((given.data / "mr_damper").glob("*.txt"))[:6]
    rows += [mr_damper(path) for path in paths]
    if given.page:
        heads = ("record", "reference", "noise, µm", "standard deviation of the force, N")
        kinds = ("published gains", "tuned PI", "noise-aware", "smoothed after the run")
        title = "The observers on measured data"
        found = table((*heads, *kinds), rows)
        write_evidence("observers-measured", title, TEXT, [found], command_line(), with_load=False)


if __name__ == "__main__":
    main()
