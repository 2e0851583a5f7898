"""The whole method on one machine: an undeclared effect is diagnosed, corrected and run again."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from dart_model.spec import load_model
from rig.demo.cases import SETTLED_NS, DemoOptions
from rig.diagnosis.files import diagnose_runs
from rig.diagnosis.outcome import CORRECTED_FILE, REPORT_FILE, Diagnosis, to_json
from rig.formats.run_arrays import open_run
from rig.pages.report import write_report
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.logged_run import Ended
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import (
    AppliedForce,
    BenchConfig,
    StrutMotion,
    UndeclaredEffect,
)

_Drive = TypeVar("_Drive", AppliedForce, StrutMotion)

_OTHER_MOTION = 1000
"""Between the seeds of two motions of a bench."""

Ranges = Mapping[str, tuple[str, Mapping[str, tuple[float, float]]]]
"""Undeclared effects that may be drawn: their family, and the range of each parameter."""


@dataclass(frozen=True)
class StoryBench:
    """A bench of the package that runs through the whole method.

    Attributes:
        configuration: Its configuration; that of the bench has `_bench` behind the name.
        strut: Strut in which the undeclared effect acts.
        effects: Effects that may be drawn.
    """

    configuration: str
    strut: str
    effects: Ranges


def _of_suspension(coulomb_n: tuple[float, float], contact_m: tuple[float, float]) -> Ranges:
    """Effects of a car's suspension, with ranges of its friction and of its stop's contact."""
    return {
        "friction": ("friction", {"coulomb_force_n": coulomb_n}),
        "cubic_stiffness": ("nonlinear_stiffness", {"stiffness_n_per_m3": (3.0e6, 1.0e7)}),
        "bump_stop": (
            "stop",
            {
                "contact_height_m": contact_m,
                "contact_stiffness_n_per_m1_5": (1.0e6, 4.0e6),
                "dissipation_s_per_m": (0.0, 0.3),
            },
        ),
        "quadratic_damping": ("nonlinear_damping", {"damping_n_s2_per_m2": (800.0, 3.0e3)}),
    }


STORIES: Mapping[str, StoryBench] = {
    "story": StoryBench(
        "story",
        "strut",
        {
            "friction": ("friction", {"coulomb_force_n": (5.0, 15.0)}),
            "cubic_stiffness": ("nonlinear_stiffness", {"stiffness_n_per_m3": (1.0e5, 4.0e5)}),
            "bump_stop": (
                "stop",
                {
                    "contact_height_m": (0.405, 0.415),
                    "contact_stiffness_n_per_m1_5": (5.0e4, 2.0e5),
                    "dissipation_s_per_m": (0.0, 0.3),
                },
            ),
            "quadratic_damping": ("nonlinear_damping", {"damping_n_s2_per_m2": (60.0, 200.0)}),
            "preload": ("preload", {"force_n": (5.0, 20.0)}),
            "added_mass": ("inertia", {"mass_kg": (0.5, 2.0)}),
            "linear_damping": ("damping", {"damping_n_s_per_m": (20.0, 60.0)}),
            "linear_stiffness": ("stiffness", {"stiffness_n_per_m": (100.0, 300.0)}),
        },
    ),
    "quarter_car_road": StoryBench(
        "quarter_car_road", "suspension", _of_suspension((40.0, 120.0), (0.335, 0.342))
    ),
    "four_post": StoryBench(
        "four_post", "suspension_fl", _of_suspension((60.0, 150.0), (0.435, 0.442))
    ),
}
"""Benches by the name of their case."""


@dataclass(frozen=True)
class Story:
    """Result of the story.

    Attributes:
        bench: The bench.
        family: Family of the undeclared effect.
        effect: The effect, as the bench names it.
        diagnosis: The diagnosis, which did not know it.
        virtual_force_rms_n: RMS of the virtual force on a fresh run, before and after.
        first_run: The run that was diagnosed.
        struts: Number of struts of the model.
    """

    bench: StoryBench
    family: str
    effect: UndeclaredEffect
    diagnosis: Diagnosis
    virtual_force_rms_n: tuple[float, float]
    first_run: Ended
    struts: int

    def summary(self) -> dict[str, object]:
        """Figures for `summary.json`."""
        before, after = self.virtual_force_rms_n
        return {
            "bench": {"family": self.family, **self.effect.model_dump(mode="json")},
            "diagnosis": json.loads(to_json(self.diagnosis)),
            "virtual_force_rms_n": {"before": before, "after": after},
            "run": self.first_run.summary(),
        }


def draw_effect(seed: int, case: str = "story") -> tuple[str, UndeclaredEffect]:
    """Family and effect of a case's bench for a seed, which is not negative."""
    bench, random = STORIES[case], np.random.default_rng(seed)
    # So that neighbouring seeds give different effects.
    name = list(bench.effects)[seed % len(bench.effects)]
    family, ranges = bench.effects[name]
    parameters = {key: float(random.uniform(low, high)) for key, (low, high) in ranges.items()}
    return family, UndeclaredEffect.model_validate(
        {"name": name, "strut": bench.strut, "parameters": parameters}
    )


def run_story(
    seed: int,
    folder: Path,
    options: DemoOptions,
    *,
    case: str = "story",
    chapter: Callable[[str], None],
    diagnosis_progress: Callable[[str, float], None],
) -> Story:
    """Run the story into `folder`.

    The first run goes over virtual CAN in real time (or in lockstep) and is diagnosed; a second one
    with another excitation is held out; a third one is run with the model before and after.

    Args:
        seed: Draws the effect.
        folder: Where to write; absent or empty.
        options: How to run it; all runs but the first one are in lockstep in any case.
        case: Name of the bench, one of `STORIES`.
        chapter: Called with the next part of the story.
        diagnosis_progress: Called with the stage of the diagnosis and the share that is done.

    Raises:
        InputError: The folder cannot be written.
    """
    bench = STORIES[case]
    family, effect = draw_effect(seed, case)
    plan = load_plan(CONFIGS / f"{bench.configuration}.yaml", duration_s=options.duration_s)
    benches = [build_bench(bench, effect, excitation) for excitation in (1, 2, 3)]

    chapter("The bridge runs with a bench that has an undeclared effect")
    first = options.run(plan, benches[0], folder / "run", lockstep=options.lockstep)
    chapter("A second run, with another excitation, is held out")
    held_out = options.run(plan, benches[1], folder / "held_out", lockstep=True)
    chapter("The first run is diagnosed")
    out = folder / "diagnosis"
    result = diagnose_runs([first.folder], plan.model, [held_out.folder], out, diagnosis_progress)
    write_report(result, out / REPORT_FILE)
    chapter("A fresh run, with the model as it was and with the corrected one")
    before = options.run(plan, benches[2], folder / "fresh_before", lockstep=True)
    corrected = plan.with_model(load_model(out / CORRECTED_FILE))
    after = options.run(corrected, benches[2], folder / "fresh_after", lockstep=True)
    story = Story(
        bench,
        family,
        effect,
        result.diagnosis,
        (_virtual_force_rms_n(before, bench.strut), _virtual_force_rms_n(after, bench.strut)),
        first,
        len(plan.struts),
    )
    (folder / "summary.json").write_text(json.dumps(story.summary(), indent=2) + "\n", "utf-8")
    return story


def build_bench(story: StoryBench, effect: UndeclaredEffect, excitation: int) -> BenchConfig:
    """The bench with an effect, and with an excitation that a number draws."""
    bench = load_bench_config(CONFIGS / f"{story.configuration}_bench.yaml")
    update: dict[str, object] = {"undeclared_effects": (effect,), "seed": excitation}
    update["applied_force"] = _excited(bench.applied_force, excitation)
    motions = enumerate(bench.prescribed_motion)
    update["prescribed_motion"] = tuple(
        _excited(motion, excitation + _OTHER_MOTION * k) for k, motion in motions
    )
    return bench.model_copy(update=update)


def _excited(drive: _Drive, seed: int) -> _Drive:
    """The same drive with another seed of its components."""
    components = tuple(item.model_copy(update={"seed": seed}) for item in drive.components)
    return drive.model_copy(update={"components": components})


def _virtual_force_rms_n(ended: Ended, strut: str) -> float:
    run = open_run(ended.folder)
    force = run.columns[f"{strut}.virtual_force_n"][run.t_s >= SETTLED_NS * 1e-9]
    return float(np.sqrt(np.mean(force**2)))
