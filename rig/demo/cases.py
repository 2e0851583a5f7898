"""Cases of the package: a bridge with a simulated bench, and the model's deviation from it."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rig.files.pictures import new_figure
from rig.log.reader import read_run
from rig.observers.pi import PiObserver
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.live import with_bench
from rig.run.logged_run import Ended
from rig.run.loop import RunControl, Watch
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate

SETTLED_NS = 500_000_000
"""Time after which figures are computed."""

CASES = ("reference", "quarter_car", "dyno")
"""Names of the cases; each has a bridge and a bench among the package's configurations."""


@dataclass(frozen=True)
class DemoOptions:
    """How the runs of a demo are made.

    Attributes:
        lockstep: Simulated time, as fast as the machine allows; otherwise real time.
        duration_s: Length; that of the configuration if None.
        stop: Called before each tick; whether to end.
        watch: Called with the state of the run five times a second.
    """

    lockstep: bool
    duration_s: float | None
    stop: Callable[[], bool]
    watch: Watch

    def run(self, ready: Plan, bench: BenchConfig, folder: Path, *, lockstep: bool) -> Ended:
        """Run a bridge with a simulated bench into a folder."""
        return with_bench(
            ready,
            bench,
            folder,
            lockstep=lockstep,
            control=RunControl(stop=self.stop, watch=self.watch),
        )


@dataclass(frozen=True)
class Figures:
    """Deviation of a model from the bench: errors of the height and of the spring-damper force.

    `force_peak_n` is the largest force of the bench.
    """

    height_error_max_m: float
    force_error_rms_n: float
    force_error_max_n: float
    force_peak_n: float


@dataclass(frozen=True)
class StrutCase:
    """One strut in a case.

    Attributes:
        name: Name of the strut.
        t_s: Times, shape (ticks,).
        truth: Height in m, velocity in m/s and force in N of the bench, shape (ticks, 3).
        defective: Height in m and force in N of the nominal model in free run, shape (ticks, 2).
        observed: The same of the model with the virtual force, shape (ticks, 2).
    """

    name: str
    t_s: NDArray[np.float64]
    truth: NDArray[np.float64]
    defective: NDArray[np.float64]
    observed: NDArray[np.float64]

    def figures(self, model: NDArray[np.float64]) -> Figures:
        """Figures of `defective` or `observed`."""
        settled = self.t_s >= SETTLED_NS * 1e-9
        height = (model[:, 0] - self.truth[:, 0])[settled]
        force = (model[:, 1] - self.truth[:, 2])[settled]
        return Figures(
            height_error_max_m=float(np.max(np.abs(height))),
            force_error_rms_n=float(np.sqrt(np.mean(force**2))),
            force_error_max_n=float(np.max(np.abs(force))),
            force_peak_n=float(np.max(np.abs(self.truth[settled, 2]))),
        )


@dataclass(frozen=True)
class Case:
    """Result of a case: the run, and bench and model strut by strut."""

    run: Ended
    struts: tuple[StrutCase, ...]

    def summary(self) -> dict[str, object]:
        """Figures for `summary.json`; those of the first strut also stand at the top level."""
        by_strut = {
            strut.name: {
                "defective": asdict(strut.figures(strut.defective)),
                "observed": asdict(strut.figures(strut.observed)),
            }
            for strut in self.struts
        }
        ended = self.run
        return {
            **next(iter(by_strut.values())),
            "struts": by_strut,
            "ticks": ended.ticks,
            "counts": ended.state.counts._asdict(),
            "timing": ended.timing.summary(),
        }


def run_case(name: str, folder: Path, options: DemoOptions) -> Case:
    """Run one of `CASES` into ``folder/run`` and write its summary and picture into `folder`.

    Raises:
        InputError: The folder cannot be written.
    """
    plan = load_plan(CONFIGS / f"{name}.yaml", duration_s=options.duration_s)
    bench = load_bench_config(CONFIGS / f"{name}_bench.yaml")
    ended = options.run(plan, bench, folder / "run", lockstep=options.lockstep)
    case = compare_with_bench(ended, plan, bench)
    (folder / "summary.json").write_text(json.dumps(case.summary(), indent=2) + "\n", "utf-8")
    for strut in case.struts:
        draw(strut, folder / f"{strut.name}.png")
    return case


def compare_with_bench(ended: Ended, plan: Plan, bench: BenchConfig) -> Case:
    """Bench, model in free run and model with virtual force along a run with a simulated bench."""
    observed = read_run(ended.folder).steps
    t_ns = np.asarray(observed.column("t_ns").to_numpy(), dtype=np.int64)
    period_ns = plan.period_ns
    truth = simulate(bench, int(t_ns[-1]) + period_ns, period_ns)
    free_run = _free_run(ended, plan, observed)
    at = t_ns // period_ns
    struts = tuple(
        StrutCase(
            name,
            np.asarray(t_ns * 1e-9, dtype=np.float64),
            np.column_stack(
                [
                    column[at, index]
                    for column in (truth.height_m, truth.velocity_m_per_s, truth.strut_force_n)
                ]
            ),
            free_run[name],
            _height_and_force(observed, name),
        )
        for index, name in enumerate(plan.config.observers)
    )
    return Case(ended, struts)


def _free_run(ended: Ended, plan: Plan, observed: pa.Table) -> dict[str, NDArray[np.float64]]:
    """Height and force of every strut of the model without virtual force."""
    names = plan.strut_names
    if plan.is_prescribed:
        # The motion is prescribed; the force of the model alone lacks the virtual force.
        virtual_n = {n: observed.column(f"{n}.virtual_force_n").to_numpy() for n in names}
        return {
            n: _height_and_force(observed, n) - np.outer(virtual_n[n], [0.0, 1.0]) for n in names
        }
    no_force = PiObserver(proportional_n_per_m=0.0, integral_n_per_m_s=0.0)
    steps = replay(ended.folder, plan=plan.with_observers(dict.fromkeys(names, no_force))).steps
    return {name: _height_and_force(steps, name) for name in names}


def _height_and_force(steps: pa.Table, strut: str) -> NDArray[np.float64]:
    columns = [steps.column(f"{strut}.{name}").to_numpy() for name in ("height_m", "force_n")]
    return np.column_stack(columns)


def draw(case: StrutCase, path: Path) -> None:
    """Draw height and force of bench and model, and their errors, over the last two seconds."""
    last = case.t_s >= case.t_s[-1] - 2.0
    t_s = case.t_s[last]
    style = {"axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False}
    with new_figure((10, 7), style) as figure:
        panels = figure.subplots(2, 2, sharex=True)
        for column, (title, of_truth, of_model, scale, unit) in enumerate(
            (("Height", 0, 0, 1e3, "mm"), ("Spring-damper force", 2, 1, 1.0, "N"))
        ):
            truth = case.truth[last, of_truth] * scale
            defective = case.defective[last, of_model] * scale
            observed = case.observed[last, of_model] * scale
            upper, lower = panels[0, column], panels[1, column]
            upper.plot(t_s, truth, color="black", label="bench")
            upper.plot(t_s, defective, color="tab:red", label="model alone")
            upper.plot(t_s, observed, "--", color="tab:blue", label="model with virtual force")
            upper.set(title=title, ylabel=f"{title.lower()} / {unit}")
            lower.plot(t_s, observed - truth, color="tab:blue")
            lower.set(title="Error with virtual force", xlabel="time / s", ylabel=f"error / {unit}")
        lines, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(lines, labels, loc="outside lower center", ncols=3)
        figure.suptitle(f"Strut “{case.name}”: bench and model over CAN")
        figure.savefig(path, dpi=110)
