"""Tables of the observers' errors: `python -m tests.observers`.

The grid: masses, natural frequencies, noises and rates. Each bench is run once with an observer
that is not tuned, what `rig tune` reads is taken from that run, and the tuned observers follow
another draw of the noise. The reference case runs through CAN, tuned with another seed than it is
run with; once in real time, joined where it moves.
"""

import argparse
import itertools
import math
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import yaml

from can_dbc.database import DEFAULT_DATABASE
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.strut_response import linearise_at
from rig.demo.cases import compare_with_bench
from rig.log.reader import read_run
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import paper_observer
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run import live
from rig.run.live import with_bench
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from rig.tuning.expectation import Expectation, longest_stretch, residual_force, spectrum
from rig.tuning.gains import Aim, TuningProblem, expect_error, gain_margin, tune_observer
from rig.tuning.tune import settings_of, tune
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.observers.benches import STRUT, Truth, follow, judged

MASSES_KG = (1.0, 10.0, 100.0, 1000.0)
NATURAL_HZ = (0.5, 2.0, 7.0, 20.0)
NOISES_M = (1e-6, 20e-6, 200e-6)
RATES_HZ = (100.0, 500.0, 2000.0)
AGO_NS, PERIOD_NS = 2_530_000_000, 1_000_000


def point(given):
    """Errors of the published gains, the tuned PI and the noise-aware observer at one point."""
    mass_kg, natural_hz, noise_m, rate_hz = given
    truth = Truth(mass_kg, natural_hz, rate_hz, max(4.0, 8.0 / natural_hz))
    rng = np.random.default_rng(abs(hash(given)) % 2**32)
    first, fresh = (
        truth.height_m + noise_m * rng.standard_normal(len(truth.height_m)) for _ in range(2)
    )
    corner_hz = 0.1 * rate_hz / 2.0 / math.pi
    start = KalmanObserver("kalman", ErrorFilter(bandwidth_hz=corner_hz, noise_std_m=noise_m), 1e7)
    answers = linearise_at(truth.plant, [truth.rest_m]).responses()
    [(mobility, *_)] = answers
    seen = longest_stretch(follow(truth, first, start), Path("grid"), STRUT, {STRUT: mobility})
    noise_std_m, residual_n = residual_force(seen, mobility)
    expectation = Expectation(noise_std_m, *spectrum(seen.t_s, residual_n), "its run")
    timing = SampleTiming(truth.period_ns)
    bench = TuningProblem(
        truth.plant, (start,), 0, answers, [truth.rest_m], timing, expectation, 1e7
    )
    settled = round(min(2.0, 0.25 * len(fresh) / rate_hz) * rate_hz)
    row = {"given": given, "noise_std_m": noise_std_m}
    for name, observer in (
        ("paper", paper_observer(bench.mobility_per_kg, bench.force_limit_n)),
        *((kind, tune_observer(bench, kind, Aim()).observer) for kind in ("pi", "kalman")),
    ):
        share, coverage = judged(truth, follow(truth, fresh, observer), settled)
        row[name] = share
        row[f"{name}_expected"] = expect_error(bench, observer).force_n
        row[f"{name}_coverage"] = coverage
        if name != "paper":
            row[f"{name}_damping"] = expect_error(bench, observer).damping_ratio
            row[f"{name}_margin"] = gain_margin(bench, observer)
    return row


def grid(jobs, one_of):
    """Rows of the grid, of one bench of so many."""
    points = list(itertools.product(MASSES_KG, NATURAL_HZ, NOISES_M, RATES_HZ))[::one_of]
    with ProcessPoolExecutor(jobs) as pool:
        rows = list(pool.map(point, points))
    print("mass/kg  f/Hz  noise/um  rate/Hz   paper/%  pi/%  kalman/%  coverage")
    for row in rows:
        mass, natural, noise, rate = row["given"]
        print(
            f"{mass:7g} {natural:5g} {noise * 1e6:9g} {rate:8g} {100 * row['paper']:9.3g}"
            f" {100 * row['pi']:6.3g} {100 * row['kalman']:8.3g} {row['kalman_coverage']:9.3f}"
            f"  {row['pi_damping']:.2f} {row['pi_margin']:.1f}",
            flush=True,
        )
    for kind in ("pi", "kalman"):
        ratios = np.array([row[kind] / row["paper"] for row in rows])
        print(
            f"{kind}: unstable {sum(not math.isfinite(row[kind]) for row in rows)} of {len(rows)};"
            f" over the published gains' median {np.median(ratios):.3f}, worst {ratios.max():.3f}"
        )
    print("published gains, error above the peak:", sum(row["paper"] > 1.0 for row in rows))
    coverages = np.array([row["kalman_coverage"] for row in rows])
    print(
        f"coverage of the 95 % intervals: mean {coverages.mean():.3f}, 5 to 95 % of the benches "
        f"{np.percentile(coverages, 5):.3f} to {np.percentile(coverages, 95):.3f}"
    )
    return rows


def reference(folder, seed, noise_m, step_m, latency_ns=0, observers=None, delay_s=0.0):
    """A run of 20 s through CAN; returns its case."""
    ready, bench = prepared(folder, seed, noise_m, step_m, latency_ns, observers, delay_s)
    ended = with_bench(ready, bench, folder / "run", lockstep=True)
    return compare_with_bench(ended, ready, bench).struts[0]


def prepared(folder, seed, noise_m, step_m, latency_ns=0, observers=None, delay_s=0.0):
    """Configuration and bench of the reference case with this noise, in a folder of its own."""
    folder.mkdir(parents=True)
    dbc = DEFAULT_DATABASE.read_text("utf-8")
    fine = "SG_ HEIGHT : 12|20@1- (2E-006,0) [-1.048576|1.048574]"
    (folder / "steps.dbc").write_text(
        dbc.replace(fine, f"SG_ HEIGHT : 12|20@1- ({step_m},0) [-1|1]")
    )
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text()) | {"seed": seed}
    height = {"signal": "HEIGHT", "strut": STRUT, "noise_std_m": noise_m}
    content["transmissions"] = [
        {"message": "BENCH_MEASUREMENT", "latency_ns": latency_ns, "height": height},
        {"message": "BENCH_MEASUREMENT_2", "applied_force": {"signal": "APPLIED_FORCE"}},
    ]
    (folder / "bench.yaml").write_text(yaml.safe_dump(content))
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    del config["timing"]
    signals = {
        "height": {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT", "delay_s": delay_s},
        "applied_force": {"message": "BENCH_MEASUREMENT_2", "signal": "APPLIED_FORCE"},
    }
    config |= {
        "dbc": "steps.dbc",
        "signals": signals,
        "publish": {"force": {"message": "RIG_ESTIMATE", "signal": "SPRING_DAMPER_FORCE"}},
        "supervision": {"stale_after_s": 0.02},
    }
    if observers is not None:
        config["observers"] = observers
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    return load_plan(folder / "rig.yaml"), load_bench_config(folder / "bench.yaml")


def share(case):
    """RMS error of the force over the peak."""
    figures = case.figures(case.observed)
    return figures.force_error_rms_n / figures.force_peak_n


def smoothed_share(case, folder):
    """The same of the force that is smoothed over the whole run."""
    seen = longest_stretch(open_steps(folder), folder, STRUT, {STRUT: 0.1})
    _, residual_n = residual_force(seen, 0.1)
    force_n = residual_n + np.interp(seen.t_s, seen.tick_s, seen.law_force_n)
    settled = seen.t_s >= 0.5
    truth = np.interp(seen.t_s, case.t_s, case.truth[:, 2])
    missed = (force_n - truth)[settled]
    return float(np.sqrt(np.mean(missed**2)) / case.figures(case.observed).force_peak_n)


def open_steps(folder):
    return read_run(folder).steps


def reference_table(seeds):
    """Median errors of each observer, % of the peak, by the name of the noise."""
    print("reference case through CAN, force error RMS over the peak in %, after 0.5 s")
    rows = {}
    for name, noise_m, step_m in (
        ("exact, resolution 2 um", 0.0, 2e-6),
        ("noise 20 um, resolution 15 um", 20e-6, 15e-6),
    ):
        with tempfile.TemporaryDirectory() as temporary:
            place = Path(temporary)
            reference(place / "tuning", 1000, noise_m, step_m)
            ready = load_plan(place / "tuning" / "rig.yaml")
            observers = {"paper": None}
            for kind in ("pi", "kalman"):
                [found] = tune(ready, place / "tuning" / "run", kind, Aim(), lambda _w, _s: None)
                observers[kind] = {STRUT: settings_of(found.tuned.observer)}
            shares = {kind: [] for kind in (*observers, "smoothed")}
            for seed, (kind, given) in itertools.product(range(1, seeds + 1), observers.items()):
                folder = place / f"{kind}{seed}"
                case = reference(folder, seed, noise_m, step_m, observers=given)
                shares[kind].append(share(case))
                if kind == "kalman":
                    shares["smoothed"].append(smoothed_share(case, folder / "run"))
        rows[name] = {kind: 100 * float(np.median(v)) for kind, v in shares.items()}
        medians = ", ".join(f"{kind} {value:.3f}" for kind, value in rows[name].items())
        print(f"  {name}: {medians}  (medians of {seeds} seeds)", flush=True)
    return rows


def latency_table():
    """Error, % of the peak, by observer and configuration."""
    rows = {}
    print("height 5 ms old, exact: force error RMS over the peak in %")
    paper_gains = {"kind": "pi", "proportional_n_per_m": 1e5, "integral_n_per_m_s": 1e4}
    follower = {"bandwidth_hz": 40.0, "noise_std_m": 5.8e-7}
    cases = (
        ("published gains, no latency", paper_gains, 0, 0.0),
        ("published gains, latency not configured", paper_gains, 5, 0.0),
        ("published gains, latency configured, no filter", paper_gains, 5, 0.005),
        (
            "published gains, latency configured, filter",
            paper_gains | {"filter": follower},
            5,
            0.005,
        ),
        ("noise-aware, latency configured", {"kind": "kalman", "filter": follower}, 5, 0.005),
    )
    for name, observer, late_ms, delay_s in cases:
        with tempfile.TemporaryDirectory() as temporary:
            given = {STRUT: observer}
            folder = Path(temporary) / "case"
            case = reference(folder, 1, 0.0, 2e-6, late_ms * 1_000_000, given, delay_s)
            rows[name] = 100 * share(case)
            print(f"  {name}: {rows[name]:.3g}", flush=True)
    return rows


class LongAgo(SimulatedBench):
    """A bench that has moved for a while when the bridge comes."""

    def __init__(self, config, database):
        super().__init__(config, database, -AGO_NS)
        self.update(-1)


def moving_table(seeds):
    """Errors of each seed, N; real time requires a machine with time to spare, ten seconds each."""
    rows = []
    print("a bench that moves since 2.53 s, 20 um noise, 15 um steps: RMS from 0.2 s on, in N")
    observers = {STRUT: {"kind": "kalman", "filter": {"bandwidth_hz": 20.0, "noise_std_m": 2e-5}}}
    for seed in range(1, seeds + 1):
        missed_n = {}
        for name, bench_class, lockstep in (
            ("from rest, lockstep", SimulatedBench, True),
            ("moving, lockstep", LongAgo, True),
            ("moving, live", LongAgo, False),
        ):
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary) / "case"
                _, bench = prepared(folder, seed, 20e-6, 15e-6, observers=observers)
                ready = load_plan(folder / "rig.yaml", duration_s=8.0)
                live.SimulatedBench = bench_class
                ended = with_bench(ready, bench, folder / "run", lockstep=lockstep)
                steps = open_steps(ended.folder)
            t_ns, force_n = (steps.column(key).to_numpy() for key in ("t_ns", f"{STRUT}.force_n"))
            since_ns = AGO_NS if bench_class is LongAgo else 0
            truth = simulate(bench, int(t_ns[-1]) + since_ns + PERIOD_NS, PERIOD_NS)
            truth_n = truth.strut_force_n[(t_ns + since_ns) // PERIOD_NS, 0]
            later = t_ns >= t_ns[np.isfinite(force_n)][0] + 200_000_000
            missed_n[name] = float(np.sqrt(np.mean((force_n - truth_n)[later] ** 2)))
        print(
            "  " + ", ".join(f"{name} {value:.2f}" for name, value in missed_n.items()), flush=True
        )
        rows.append(missed_n)
    return rows


TEXT = """
The force error is the RMS difference between the estimated force and that of the simulated bench.
Four estimates are compared: the PI observer with the published gains (those of the
[reference case](../explanation/method.md#the-reference-case)), a PI observer and a noise-aware
observer that are tuned as by `rig tune`, and the force smoothed after the run. An observer is tuned
on one run and evaluated on runs with other noise; in the tables of latency and of a bridge that
joins a moving bench, the gains are fixed.

The runs over CAN use the shipped reference case. The benches of the grid have other masses and
natural frequencies, a spring that hardens and a damper with a knee; their linear model has three
quarters of the stiffness and half of the damping. All benches are simulated: errors of real
sensors, other than white noise, resolution and latency, are not included.
"""
NAMES = {
    "paper": "published gains",
    "pi": "tuned PI",
    "kalman": "noise-aware",
    "smoothed": "smoothed after the run",
}


def reference_part(rows, seeds):
    heads = ["heights", *(NAMES[kind] for kind in next(iter(rows.values())))]
    cells = [
        (name.replace("um", "µm"), *(_percent(value) for value in row.values()))
        for name, row in rows.items()
    ]
    words = (
        "Reference case over CAN, 20 s: force error relative to the peak force "
        f"(medians of {seeds} seeds):"
    )
    return [words, table(heads, cells)]


def latency_part(rows):
    words = (
        "Reference case with exact heights that are 5 ms old, one seed: force error relative to "
        "the peak force (*latency configured*: with `delay_s: 0.005`):"
    )
    cells = [(name, _percent(value)) for name, value in rows.items()]
    return [words, table(("observer", "error"), cells)]


def moving_part(rows):
    words = (
        "A bridge that joins a bench which has been moving for 2.53 s (noise of 20 µm, resolution "
        "of 15 µm), noise-aware observer with a bandwidth of 20 Hz: force error in N (RMS), from "
        "0.2 s after the first estimate on. *From rest*: bench and bridge start together. Live "
        "runs are in real time:"
    )
    cells = [
        (seed, *(f"{value:.2f}" for value in row.values())) for seed, row in enumerate(rows, 1)
    ]
    return [words, table(("seed", *rows[0]), cells)]


def grid_part(rows):
    """What the grid shows, by observer."""
    cells = []
    for kind in ("pi", "kalman"):
        ratios = np.array([row[kind] / row["paper"] for row in rows])
        unstable = sum(not math.isfinite(row[kind]) for row in rows)
        cells.append((NAMES[kind], unstable, f"{np.median(ratios):.2g}", f"{ratios.max():.2g}"))
    held = 100 * np.array([row["kalman_coverage"] for row in rows])
    low, high = np.percentile(held, [5, 95])
    words = (
        f"{len(rows)} benches of the grid: {_span(MASSES_KG, 1)} kg, natural frequencies of "
        f"{_span(NATURAL_HZ, 1)} Hz, noise of {_span(NOISES_M, 1e6)} µm, {_span(RATES_HZ, 1)} "
        "heights per second. The errors are divided by those with the published gains, which are "
        "scaled with the mass. A ratio near zero means that the error with the published gains is "
        "far larger than the force itself, as in an unstable loop:"
    )
    return [
        words,
        table(("observer", "unstable benches", "median ratio of errors", "largest ratio"), cells),
        "With the published gains the error is larger than the peak of the force on "
        f"{sum(row['paper'] > 1.0 for row in rows)} of these benches.",
        f"The 95 % intervals of the noise-aware observer contain {held.mean():.1f} % of the true "
        f"forces on average, and {low:.1f} to {high:.1f} % on nine of ten benches.",
    ]


def _percent(value):
    return f"{value:.3g} %" if value < 100.0 else f"{value:.0f} %"


def _span(values, factor):
    return f"{factor * min(values):g} to {factor * max(values):g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--one-of", type=int, default=1, help="one bench of N of the grid")
    parser.add_argument("--only", choices=("reference", "latency", "moving", "grid"))
    add_page_option(parser)
    given = parser.parse_args()
    parts = []
    if given.only in (None, "reference"):
        parts += reference_part(reference_table(given.seeds), given.seeds)
    if given.only in (None, "latency"):
        parts += latency_part(latency_table())
    if given.only in (None, "moving"):
        parts += moving_part(moving_table(given.seeds))
    if given.only in (None, "grid"):
        parts += grid_part(grid(given.jobs, given.one_of))
    if given.page:
        write_evidence(
            "observers", "Errors of the observers", TEXT, parts, command_line(), with_load=False
        )


if __name__ == "__main__":
    main()
