"""Mutated files of every kind: each is read, or refused in one line that says why.

What was not mutated is read once, so that ten thousand files of a kind take less than a minute.
"""

import random
import re
from math import isfinite, sin

import pytest
import yaml

import rig.log.reader
import rig.plan.load
from can_dbc.errors import DatabaseError, InputError
from rig.formats.mapping import load_mapping
from rig.log.file_names import DBC_FILE, FRAMES_FILE, MODEL_FILE, RUN_FILE, STEPS_FILE
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfigError
from tests.faults.test_machine import lockstep

REFUSED = (InputError, DatabaseError, BenchConfigError, RecordingError)
"""What a wrong input is allowed to raise."""

OF_A_RUN = (RUN_FILE, FRAMES_FILE, STEPS_FILE, DBC_FILE, MODEL_FILE)
OTHERS = ("config", "bench", "mapping", "csv")
MOST_TICKS = 100_000


def mangled(rng, data):
    """Bytes with some of them changed, lost, repeated or inserted."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        start = rng.randrange(len(result) + 1)
        size = rng.choice((1, 1, 4, 40))
        match rng.randrange(6):
            case 0:
                result[start : start + size] = rng.randbytes(size)
            case 1:
                del result[start : start + size]
            case 2:
                result[start:start] = rng.randbytes(size)
            case 3:
                result[start:start] = result[start : start + size]
            case 4:
                # Text stays text: only so does a mutation get behind the parser.
                result[start : start + 1] = rng.choice((b"0", b"9", b"-", b".", b"e", b" ", b"a"))
            case _:
                del result[start:]
    return bytes(result)


def is_accepted(read):
    """Whether a file was read; a refusal is one line."""
    try:
        read()
    except REFUSED as error:
        said = str(error)
    else:
        return True
    assert len(said.splitlines()) == 1
    return False


def once_for_each_content(read):
    """A reader that remembers what it read last."""
    known = {}

    def remembered(path):
        content = path.read_bytes()
        if content not in known:
            known.clear()
            known[content] = read(path)
        return known[content]

    return remembered


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of 40 ticks with no more in its files than a replay needs."""
    folder = tmp_path_factory.mktemp("fuzz") / "run"
    lockstep(folder, "fuzz", 0.04)
    dbc = folder / DBC_FILE
    lines = [line for line in dbc.read_text().splitlines() if not line.startswith("CM_")]
    unused = re.compile(r"\b(257|258|273|289|784)\b")
    texts = [
        text
        for text in "\n".join(lines).split("\n\n")
        if not re.match("BO_ " + unused.pattern, text)
    ]
    kept = [line for line in "\n\n".join(texts).splitlines() if not unused.search(line)]
    dbc.write_text("\n".join(kept) + "\n")
    header = yaml.safe_load((folder / RUN_FILE).read_text())
    header["config"]["timing"] = None
    kept_keys = {key: header[key] for key in ("schema", "epoch_ns", "config")}
    (folder / RUN_FILE).write_text(yaml.safe_dump(kept_keys, sort_keys=False))
    assert replay(folder).different == 0
    return folder


@pytest.fixture
def known(monkeypatch):
    """Reads what stays the same once."""
    for module, name in (
        (rig.plan.load, "load_database"),
        (rig.plan.load, "load_model"),
    ):
        monkeypatch.setattr(module, name, once_for_each_content(getattr(module, name)))
    parse, texts = rig.log.reader.parse_mapping, {}

    def parse_once(text, source):
        if text not in texts:
            texts.clear()
            texts[text] = parse(text, source)
        return texts[text]

    monkeypatch.setattr(rig.log.reader, "parse_mapping", parse_once)


def replay_is_sound(folder):
    """Compute a run again; whatever its files say, nothing that is published as valid is NaN."""
    steps = replay(folder).steps
    assert steps.num_rows < MOST_TICKS
    valid, force_n = (steps[f"strut.{name}"].to_pylist() for name in ("valid", "force_n"))
    assert all(isfinite(n) for n, is_valid in zip(force_n, valid, strict=True) if is_valid == 1.0)


def csv_text():
    rows = [
        f"{k * 5e-3:.3f},{0.4 + 0.05 * sin(0.3 * k):.6f},{90 * sin(0.1 * k):.2f}"
        for k in range(240)
    ]
    return "\n".join(["t_s,height_m,applied_force_n", *rows, ""])


def other(kind):
    """Content, name and reader of a file that belongs to no run."""
    match kind:
        case "config":
            return (CONFIGS / "reference.yaml").read_bytes(), "reference.yaml", load_plan
        case "bench":
            return (CONFIGS / "story_bench.yaml").read_bytes(), "bench.yaml", load_bench_config
        case "mapping":
            return (CONFIGS / "dyno_mapping.yaml").read_bytes(), "mapping.yaml", load_mapping
        case _:
            return csv_text().encode(), "run.csv", read_recording


def fuzz(original, path, read, count, seed):
    """How many of some mutated files are accepted."""
    rng = random.Random(seed)
    accepted = 0
    for _ in range(count):
        path.write_bytes(mangled(rng, original))
        accepted += is_accepted(read)
    return accepted


def fuzz_run(run, folder, name, count):
    for path in run.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    path = folder / name
    return fuzz(path.read_bytes(), path, lambda: replay_is_sound(folder), count, name)


def fuzz_other(folder, kind, count):
    content, name, read = other(kind)
    path = folder / name
    path.write_bytes(content)
    assert is_accepted(lambda: read(path))
    return fuzz(content, path, lambda: read(path), count, kind)


@pytest.mark.slow
@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", OF_A_RUN)
def test_mutated_files_of_a_run(run, tmp_path, name):
    assert fuzz_run(run, tmp_path, name, 60) < 60


@pytest.mark.parametrize("kind", OTHERS)
def test_mutated_files(tmp_path, kind):
    assert fuzz_other(tmp_path, kind, 60) < 60


@pytest.mark.long
@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", OF_A_RUN)
def test_a_thousand_mutated_files_of_a_run(run, tmp_path, name):
    print(name, fuzz_run(run, tmp_path, name, 1_000), "of 1000 accepted")


@pytest.mark.long
@pytest.mark.parametrize("kind", OTHERS)
def test_a_thousand_mutated_files(tmp_path, kind):
    print(kind, fuzz_other(tmp_path, kind, 1_000), "of 1000 accepted")
