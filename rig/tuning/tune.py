"""From a configuration and a run to a configuration with tuned observers."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

if TYPE_CHECKING:
    import pyarrow as pa
    from _typeshed import DataclassInstance

from can_dbc.codec import si_step
from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text
from dart_model.errors import ModelError
from dart_model.protocol import AnyPlant
from rig.channels.channel import Channel
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.poles import OperatingPoint
from rig.closed_loop.strut_response import FAST_SPEED_M_PER_S, linearise_at
from rig.diagnosis.progress import Progress, within
from rig.files.yaml_edit import edit_keys
from rig.log.reader import read_run
from rig.observers.error_model import ErrorModel
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import paper_observer
from rig.observers.protocol import AnyObserver, AnyTunableObserver
from rig.plan.build import build_plant
from rig.plan.load import plan_of_run
from rig.plan.plan import Plan
from rig.run.replay import replay
from rig.tuning.expectation import (
    Expectation,
    expectation_from_noise,
    expectations_from_run,
    operating_points,
)
from rig.tuning.gains import (
    Aim,
    ExpectedError,
    Tuned,
    TuningProblem,
    expect_error,
    sweep_bandwidth,
    tune_observer,
)
from rig.tuning.latency import Latency, estimate_latencies, with_delay

_FACTORS = tuple(2.0 ** (step / 6.0) for step in range(-15, 16))
"""Of the bandwidths that are plotted: from a sixth to six times the choice."""


class StatedExpectation(NamedTuple):
    """RMS and highest frequency of the residual force, as the user states them without a run.

    Attributes:
        noise_std_m: Standard deviation of the height; by the DBC's resolution if None.
    """

    rms_n: float
    up_to_hz: float
    noise_std_m: float | None = None


@dataclass(frozen=True)
class TunedStrut:
    """A strut whose observer was tuned.

    Attributes:
        expectation: What it was tuned for.
        latency: Delay of its height as the run shows it; None where it was given.
        delay_s: Delay that it was tuned with.
        configured: Expected error of the observer as it is configured.
        published: Expected error of the published gains, scaled by the effective mass.
        others_in_motion: Least damping ratio at the run's operating points of both of these.
        sweep: Expected errors at other bandwidths, by their frequencies in Hz.
    """

    name: str
    expectation: Expectation
    latency: Latency | None
    delay_s: float
    tuned: Tuned
    configured: ExpectedError
    published: ExpectedError
    others_in_motion: tuple[float, float]
    bandwidth_hz: float
    sweep: list[tuple[float, ExpectedError]]


def tune(
    plan: Plan, source: Path | StatedExpectation, kind: str, aim: Aim, progress: Progress
) -> list[TunedStrut]:
    """Tune the observer of every strut for a run of the bench, or for what is expected of it.

    The kind is one of `rig.tuning.gains.KINDS`.

    Raises:
        InputError: The run cannot be used.
    """
    if plan.is_prescribed:
        raise InputError(
            f"{plan.source}: prescribed_motion: no loop is closed, expected a free model"
        )
    observed = [i for i, strut in enumerate(plan.struts) if strut.observer.estimates_force]
    if not observed:
        raise InputError(
            f"{plan.source}: observers: kind none of every strut, expected an observer to tune"
        )
    if isinstance(source, StatedExpectation) and source.up_to_hz >= 0.5e9 / plan.period_ns:
        raise InputError(
            f"--up-to-hz {source.up_to_hz:g}: expected less than half of rate_hz, "
            f"{0.5e9 / plan.period_ns:g}"
        )
    plant = build_plant(plan)
    at_rest_m = [strut.free_length_m for strut in plan.struts]
    assumed = linearise_at(plant, at_rest_m)
    progress("reading what is to be expected", 0.0)
    steps = read_run(source).steps if isinstance(source, Path) else None
    points = [OperatingPoint(at_rest_m, FAST_SPEED_M_PER_S)]
    if steps is not None:
        found = operating_points(steps, plan.strut_names)
        points = [point for point in found if _is_reached(plant, point)] or points
    expectations = _expectations(plan, source, steps, observed, assumed)
    loops = _Loops(plan, plant, assumed, points, expectations)
    if isinstance(source, Path) and (recorded := plan_of_run(source)).model != plan.model:
        progress("the run with this model", 0.0)
        loops = _follow_with_own_model(loops, recorded, source, aim)
    tuned: list[TunedStrut] = []
    progress("latency", 0.0)
    latencies = _latencies(plan, source, observed)
    for number, (index, latency) in enumerate(zip(observed, latencies, strict=True)):
        strut, share = plan.struts[index], (number / len(observed), (number + 1) / len(observed))
        part = within(progress, *share, of=strut.name)
        delay_s = _delay_s(plan, strut.name, latency)
        problem = loops.problem(index, delay_s)
        part("gains", 0.2)
        chosen = tune_observer(problem, kind, aim)
        part("other bandwidths", 0.7)
        published = paper_observer(problem.mobility_per_kg, problem.force_limit_n)
        tuned.append(
            TunedStrut(
                strut.name,
                problem.expectation,
                latency,
                delay_s,
                chosen,
                expect_error(problem, strut.observer),
                expect_error(problem, published),
                (problem.damping_in_motion(strut.observer), problem.damping_in_motion(published)),
                chosen.observer.bandwidth_hz(problem.mobility_per_kg),
                sweep_bandwidth(problem, chosen.observer, _FACTORS),
            )
        )
    return tuned


def _is_reached(plant: AnyPlant, point: OperatingPoint) -> bool:
    """Whether a model has such heights: those of more struts than coordinates need not agree."""
    try:
        plant.init(point.heights_m)
    except ModelError:
        return False
    return True


def _expectations(
    plan: Plan,
    source: Path | StatedExpectation,
    steps: "pa.Table | None",
    observed: Sequence[int],
    assumed: ErrorModel,
) -> dict[int, Expectation]:
    """What the observers of some struts have to expect, from the steps of a run or as stated."""
    names = [plan.strut_names[index] for index in observed]
    found: list[Expectation] = []
    if steps is not None and isinstance(source, Path):
        together = assumed.mobility_per_kg[np.ix_(observed, observed)]
        found = expectations_from_run(steps, source, names, together)
    elif isinstance(source, StatedExpectation):
        heights = {height.name: height for height in plan.heights}
        for name in names:
            noise_std_m = source.noise_std_m or _quantisation_m(heights[name])
            found.append(expectation_from_noise(noise_std_m, source.rms_n, source.up_to_hz))
    return dict(zip(observed, found, strict=True))


def _follow_with_own_model(loops: "_Loops", recorded: Plan, run: Path, aim: Aim) -> "_Loops":
    """The loops, with what is to be expected of a run that another model followed.

    Its frames are replayed, with observers that are stable with the model that is tuned.
    """
    plan = loops.plan
    followers = {
        strut.name: tune_observer(loops.problem(index, 0.0), "kalman", aim).observer
        if index in loops.expectations
        else strut.observer
        for index, strut in enumerate(plan.struts)
    }
    own = recorded.with_model(plan.model).with_observers(followers)
    steps, observed = replay(run, plan=own).steps, list(loops.expectations)
    found = _expectations(plan, run, steps, observed, loops.assumed)
    return loops._replace(expectations=found)


class _Loops(NamedTuple):
    """The loops of a plan's struts, of each of which an observer is tuned.

    Attributes:
        plan: The configuration.
        plant: Its model.
        assumed: Motion that the observers take the model to have.
        points: Motions in which the loops have to be stable.
        expectations: What the observer of each strut has to expect that is tuned, by its index.
    """

    plan: Plan
    plant: AnyPlant
    assumed: ErrorModel
    points: Sequence[OperatingPoint]
    expectations: Mapping[int, Expectation]

    def problem(self, index: int, delay_s: float) -> TuningProblem:
        """What is to be tuned of a strut whose height has a delay."""
        struts = self.plan.struts
        others = tuple(
            KalmanObserver.before_tuning(self.expectations[number].noise_std_m, strut.interval_ns)
            if number in self.expectations
            else strut.observer
            for number, strut in enumerate(struts)
        )
        return TuningProblem(
            self.plant,
            others,
            index,
            self.assumed,
            [strut.free_length_m for strut in struts],
            SampleTiming.of(self.plan.period_ns, struts[index].interval_ns, round(delay_s * 1e9)),
            self.expectations[index],
            cast("AnyTunableObserver", struts[index].observer).force_limit_n,
            self.points,
        )


def _latencies(
    plan: Plan, source: Path | StatedExpectation, observed: Sequence[int]
) -> list[Latency | None]:
    """Latencies of the observed heights as the run shows them; None where one is given.

    None, too, where there is no run, or where the height of a strut is not measured.
    """
    heights = plan.config.signals.height
    given_s = [heights[plan.strut_names[index]].delay_s for index in observed]
    is_measured = all(name in heights for name in plan.strut_names)
    if not isinstance(source, Path) or all(given_s) or not is_measured:
        return [None] * len(given_s)
    found = estimate_latencies(source, plan.model, plan.strut_names)
    chosen = [found[index] for index in observed]
    return [None if given else latency for given, latency in zip(given_s, chosen, strict=True)]


def _delay_s(plan: Plan, strut: str, latency: Latency | None) -> float:
    """The delay to tune with: the configuration's, or the one that the run shows."""
    if latency is None:
        return plan.config.signals.height[strut].delay_s
    return float(f"{latency.delay_s:.3g}") if latency.low_s > 0.0 else 0.0


def write_config(plan: Plan, tuned: list[TunedStrut], path: Path, model: str | None = None) -> None:
    """Write the configuration with the tuned observers, and another model; comments stay.

    The file is a new one in the folder of the configuration, whose other files it names.

    Args:
        plan: Of the configuration.
        tuned: Struts with their observers.
        path: The new file.
        model: File or name of the model with which they were tuned; the configuration's if None.

    Raises:
        InputError: The file exists, lies elsewhere or cannot be written.
    """
    if path.absolute().parent != plan.source.absolute().parent:
        raise InputError(
            f"--out {path}: expected a file in the folder of {plan.source}, whose files it names"
        )
    observers = {strut.name: strut.tuned.observer for strut in tuned}
    top: dict[str, object] = {
        "observers": {
            strut.name: settings_of(observers.get(strut.name, strut.observer))
            for strut in plan.struts
        }
    }
    if model is not None:
        is_file = Path(model).exists()
        top["model"] = os.path.relpath(model, plan.source.absolute().parent) if is_file else model
    text = read_text(plan.source)
    changes: list[tuple[list[str], dict[str, object]]] = [([], top)]
    late = {strut.name: strut.delay_s for strut in tuned if strut.latency and strut.delay_s}
    if late:
        supervision = with_delay(plan, max(late.values())).config.supervision
        content = parse_mapping(text, str(plan.source))
        ages: dict[str, object] = {
            "stale_after_s": round(supervision.stale_after_s, 9),
            "safe_after_s": round(supervision.safe_after_s, 9),
        }
        if content.get("supervision"):
            changes.append((["supervision"], ages))
        else:
            top["supervision"] = ages
        heights = cast("dict[str, dict[str, object]]", content["signals"])["height"]
        # A model of one strut leaves its name out.
        for name, delay_s in late.items():
            place = ["signals", "height", *([name] if name in heights else [])]
            changes.append((place, {"delay_s": delay_s}))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(edit_keys(text, changes))
    except OSError as error:
        raise InputError(f"--out {path}: {os.strerror(error.errno or 0)}") from error


def settings_of(observer: AnyObserver) -> dict[str, object]:
    """An observer as it stands in a configuration; what is absent or zero there is left out."""
    return {
        key: value for key, value in asdict(cast("DataclassInstance", observer)).items() if value
    }


def _quantisation_m(height: Channel) -> float:
    """Standard deviation of the rounding of a height to its signal's steps."""
    if height.message is None:
        raise InputError(f"{height.key}: is on no bus, expected --noise-std-m")
    step_m = si_step(height.message, height.signal, height.quantity.dimension)
    if step_m <= 0.0:
        raise InputError(
            f"{height.message.name}.{height.signal}: has no steps to take the noise from, expected "
            "--noise-std-m"
        )
    return step_m / 12.0**0.5
