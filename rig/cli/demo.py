"""`rig demo`."""

from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError, expected_name
from rig.cli.progress import progress_bar, status_line, stoppable
from rig.cli.result_tables import print_case, print_diagnosis, print_run
from rig.cli.terminal import JsonFlag, console, print_json, print_text
from rig.files.folders import free_folder, refuse_full

STORY = "story"
STORIES = (STORY, "quarter_car_road", "four_post")
"""Cases that run the whole method (`rig.demo.story.STORIES`)."""

EXAMPLES = (
    "Examples: `rig demo` · `rig demo --seed 2` · `rig demo --case quarter_car_road` · "
    "`rig demo --case reference --lockstep --out /tmp/reference`"
)


def demo(
    case: Annotated[
        str,
        typer.Option(
            metavar="CASE",
            help=f"The whole method: {', '.join(STORIES)}; a run alone: reference, quarter_car or "
            "dyno.",
        ),
    ] = STORY,
    seed: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, help="Number that selects the effect of the story's bench."
        ),
    ] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="New folder; by default rig-demo, or if it exists rig-demo-2, ..."
        ),
    ] = None,
    lockstep: Annotated[
        bool,
        typer.Option("--lockstep", help="Use a simulated clock, as fast as the machine allows."),
    ] = False,
    duration_s: Annotated[
        float | None, typer.Option(metavar="S", min=1.0, help="Duration of each run.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Run a simulated bench and the bridge on this machine, over virtual CAN.

    By default, the bench has an effect that the model lacks. A run is logged and diagnosed, the
    model is corrected, and the bench is run again.
    """
    from rig.demo.cases import CASES, DemoOptions, run_case

    if case not in (*STORIES, *CASES):
        raise InputError(f"--case {case!r}: {expected_name(case, (*STORIES, *CASES))}")
    out = out or free_folder(Path("rig-demo"))
    refuse_full(out)
    if case in STORIES:
        _run_story(case, seed, out, lockstep=lockstep, duration_s=duration_s, as_json=as_json)
        return
    with stoppable() as stop, status_line(duration_s) as watch:
        result = run_case(case, out, DemoOptions(lockstep, duration_s, stop, watch))
    if as_json:
        print_json(result.summary())
        return
    print_case(result)
    print_run(result.run, with_timing=not lockstep)
    print_text(f"Written: {out}/summary.json, a picture of each strut, and the run {out}/run")


def _run_story(
    case: str, seed: int, out: Path, *, lockstep: bool, duration_s: float | None, as_json: bool
) -> None:
    from rig.demo.cases import DemoOptions
    from rig.demo.story import run_story

    with stoppable() as stop, status_line(duration_s) as watch, progress_bar() as bar:

        def chapter(text: str) -> None:
            if stop():
                raise typer.Abort
            if not as_json:
                console.print(f"- {text}")

        story = run_story(
            seed,
            out,
            DemoOptions(lockstep, duration_s, stop, watch),
            case=case,
            chapter=chapter,
            diagnosis_progress=bar,
        )
    if as_json:
        print_json(story.summary())
        return
    print_run(story.first_run, with_timing=not lockstep)
    print_diagnosis(story.diagnosis, struts=story.struts)
    before, after = story.virtual_force_rms_n
    where = f" of {story.bench.strut}" if story.struts > 1 else ""
    parameters = ", ".join(f"{key} {value:.4g}" for key, value in story.effect.parameters.items())
    console.print(
        f"On a fresh run the virtual force{where} falls from {before:.2f} N to {after:.2f} N RMS.\n"
        f"Effect of the bench, which the diagnosis did not know: {story.effect.name} "
        f"(family {story.family}): {parameters}.\n"
        f"Report: {out}/diagnosis/report.html\n"
        f"Both runs in the browser: rig view {out}/fresh_before {out}/fresh_after"
    )
