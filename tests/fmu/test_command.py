"""`rig export --fmu`, as a user types it."""

import importlib.util
import sys
import zipfile

import fmpy
import pytest

from dart_model.spec import MODELS, dump_model
from rig.cli.main import main
from tests.fmu.specimens import with_effects

REFERENCE = str(MODELS / "reference.yaml")
QUARTER_CAR = str(MODELS / "quarter_car.yaml")


@pytest.fixture
def rig(monkeypatch, capsys):
    """The command: its exit code, and what it printed."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        else:
            code = 0
        printed = capsys.readouterr()
        return code, printed.out + printed.err

    return call


@pytest.mark.long
def test_a_corrected_model_becomes_an_fmu(rig, tmp_path):
    model = tmp_path / "corrected.yaml"
    model.write_text(dump_model(with_effects("cubic_stiffness", "coulomb_friction")))
    out = tmp_path / "bench.fmu"
    code, said = rig("export", model, "--fmu", "--bench", "--fmi", "3.0", "--out", out)
    assert code == 0, said
    assert "inputs: applied_force_n, temperature_c" in said
    description = fmpy.read_model_description(str(out))
    assert description.fmiVersion == "3.0"
    assert description.coSimulation is not None
    assert description.modelExchange is not None
    with zipfile.ZipFile(out) as zipped:
        assert sum(name.startswith("binaries/") for name in zipped.namelist()) == 5


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ((QUARTER_CAR, "--fmu"), "--strut: expected one of tyre, suspension, or --bench"),
        ((QUARTER_CAR, "--fmu", "--bench"), "expected one on a straight"),
        ((QUARTER_CAR, "--fmu", "--strut", "wheel"), "wheel"),
        ((REFERENCE, "--fmu", "--fmi", "1.0"), "--fmi '1.0': expected 2.0 or 3.0"),
        ((REFERENCE, "--fmu", "--format", "mf4"), "--format and --fmu: expected one of them"),
        ((REFERENCE,), "--format and --fmu: expected one of them"),
        ((REFERENCE, "--fmu", "--bench", "--strut", "strut"), "expected one of them"),
        ((REFERENCE, "--bench", "--format", "mf4"), "expected --fmu with them"),
        (("nowhere.yaml", "--fmu"), "nowhere.yaml"),
    ],
)
def test_what_cannot_be_exported_is_one_line(rig, tmp_path, given, line):
    out = tmp_path / "it.fmu"
    code, said = rig("export", *given, "--out", out)
    assert code == 2
    assert line in said
    assert len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_a_file_that_exists_is_kept(rig, tmp_path):
    out = tmp_path / "it.fmu"
    out.write_text("mine")
    code, said = rig("export", REFERENCE, "--fmu", "--out", out)
    assert code == 2
    assert "exists, expected a new file" in said
    assert out.read_text() == "mine"


def test_without_the_compiler_one_line_says_what_to_install(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    code, said = rig("export", REFERENCE, "--fmu", "--out", tmp_path / "it.fmu")
    assert code == 2
    assert "pip install -e '.[fmu]'" in said
