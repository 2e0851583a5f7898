"""Names of the files in a run's folder.

    run.yaml        what was known before the first tick, and how the run ended
    frames.log      every frame, received (R) and sent (T), in candump's format with ns
    steps.arrow     one record a tick, as an Arrow IPC stream
    model.yaml      the model
    bus.dbc         the DBC
    changes.jsonl   changes of the configuration during the run
    events.jsonl    changes of the mode, with their causes, and what the machine did to the run
    timing.json     histograms of its ticks
    trace.arrow     parts of its late ticks, if they were traced
    added.arrow     virtual sensors that were computed after it
    checksums.txt   lengths and checksums of the finished files of frames and steps
    captures/       windows around its faults, each a run folder

Where a run was rotated, `frames.0001.log` and `steps.0001.arrow` follow, and so on; after 9999
comes 10000.
"""

from pathlib import Path

RUN_FILE, FRAMES_FILE, STEPS_FILE = "run.yaml", "frames.log", "steps.arrow"
MODEL_FILE, DBC_FILE = "model.yaml", "bus.dbc"
CHANGES_FILE, HISTOGRAMS_FILE, TRACE_FILE = "changes.jsonl", "timing.json", "trace.arrow"
ADDED_FILE = "added.arrow"
CAPTURES_FOLDER, EVENTS_FILE, CHECKSUMS_FILE = "captures", "events.jsonl", "checksums.txt"


def parts(folder: Path, name: str) -> list[Path]:
    """A file of a run and what it was continued in, in their order."""
    stem, _, ending = name.partition(".")
    numbered = {
        int(number): path
        for path in folder.glob(f"{stem}.*.{ending}")
        if (number := path.name[len(stem) + 1 : -len(ending) - 1]).isdecimal()
        and path.name == part_name(name, int(number))
    }
    return [folder / name, *(numbered[number] for number in sorted(numbered))]


def part_name(name: str, number: int) -> str:
    """Name of a file's part; the first, number 0, has the plain name."""
    stem, _, ending = name.partition(".")
    return f"{stem}.{number:04d}.{ending}" if number else name
