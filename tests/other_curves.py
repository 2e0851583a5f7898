"""The reference case with other curves of the bench: `python -m tests.other_curves`.

The paper gives no curves of its spring and damper; those of the shipped bench were chosen so that
its figures are met. Here the slope of each curve is multiplied, along the curve, by a smooth factor
drawn between half and two, and the same observer follows.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from rig.demo.cases import SETTLED_NS, compare_with_bench
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from tests.evidence import add_page_option, command_line, table, write_evidence

FIGURES = (
    "largest height error, mm",
    "force error (RMS), N",
    "force error (RMS) relative to the peak, %",
    "peak force, N",
)
TEXT = """
Cuesta, Luque and Mantaras (2021) published the [method](../explanation/method.md), but not the
curves of their spring and damper. The curves of the shipped reference bench were chosen so that
errors close to the published ones result (2.5 mm of height and 1.14 % of the peak force). This page
shows the errors with other curves: the slopes of the spring curve and of the damper curve are
multiplied by a smooth factor, drawn at random between 0.5 and 2. Observer and model are those of
the reference case. Each bench runs in lockstep for 20 s, and its values are encoded in CAN frames;
the first {settled_s:g} s are not evaluated. An error is the model's height, or the estimated force,
less that of the simulated bench. The peak force is the largest magnitude of the simulated strut
force in the evaluated time.
"""


def redrawn(
    at: tuple[float, ...], forces: tuple[float, ...], rng: np.random.Generator
) -> list[float]:
    """A curve with other slopes, which is where it was in its middle."""
    knots = rng.uniform(-np.log(2.0), np.log(2.0), 4)
    along = np.linspace(0.0, 1.0, len(at) - 1)
    factors = np.exp(PchipInterpolator(np.linspace(0.0, 1.0, 4), knots)(along))
    rises = np.diff(forces) * factors
    curve = np.concatenate([[0.0], np.cumsum(rises)])
    middle = len(at) // 2
    return (curve - curve[middle] + forces[middle]).tolist()


def other(bench: BenchConfig, rng: np.random.Generator) -> BenchConfig:
    """The bench with redrawn curves of spring and damper."""
    (strut,) = bench.struts
    spring, damper = strut.spring, strut.damper
    changed = strut.model_copy(
        update={
            "spring": spring.model_copy(
                update={"force_n": tuple(redrawn(spring.height_m, spring.force_n, rng))}
            ),
            "damper": damper.model_copy(
                update={"force_n": tuple(redrawn(damper.velocity_m_per_s, damper.force_n, rng))}
            ),
        }
    )
    return bench.model_copy(update={"struts": (changed,)})


def write_page(rows: list[tuple[float, float, float, float]]) -> None:
    """Write the guide's page: each bench, and the spread."""
    benches = [
        (number, *(f"{value:.4g}" for value in row)) for number, row in enumerate(rows, start=1)
    ]
    spread = [
        (name, *(f"{value:.4g}" for value in np.percentile(column, [50, 0, 100])))
        for name, column in zip(FIGURES, np.array(rows).T, strict=True)
    ]
    write_evidence(
        "other-curves",
        "The reference case with other curves",
        TEXT.format(settled_s=SETTLED_NS * 1e-9),
        [
            table((f"over the {len(rows)} benches", "median", "smallest", "largest"), spread),
            table(("bench", *FIGURES), benches),
        ],
        command_line(),
        with_load=False,
    )


def main() -> None:
    """Print the errors with each bench, and their spread."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--benches", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    shipped = load_bench_config(CONFIGS / "reference_bench.yaml")
    ready = load_plan(CONFIGS / "reference.yaml")
    rows: list[tuple[float, float, float, float]] = []
    for number in range(asked.benches):
        bench = other(shipped, rng)
        with tempfile.TemporaryDirectory() as folder:
            ended = with_bench(
                ready,
                bench,
                Path(folder) / "run",
                lockstep=True,
            )
            (strut,) = compare_with_bench(ended, ready, bench).struts
        figures = strut.figures(strut.observed)
        rows.append(
            (
                figures.height_error_max_m * 1e3,
                figures.force_error_rms_n,
                100.0 * figures.force_error_rms_n / figures.force_peak_n,
                figures.force_peak_n,
            )
        )
        print(
            f"{number}: height {rows[-1][0]:.2f} mm, force {rows[-1][1]:.2f} N = "
            f"{rows[-1][2]:.2f} % of the peak of {rows[-1][3]:.0f} N"
        )
    columns = np.array(rows).T
    for name, column in zip(
        ("height / mm", "force / N", "force / % of peak"), columns, strict=False
    ):
        low, middle, high = np.percentile(column, [0, 50, 100])
        print(f"{name}: median {middle:.2f}, {low:.2f} to {high:.2f}, after {SETTLED_NS * 1e-9} s")
    if asked.page:
        write_page(rows)


if __name__ == "__main__":
    main()
