"""`rig init`, from a DBC to a configuration that can be checked, with and without a terminal."""

import json
import re
import sys

import numpy as np
import pytest

from rig.cli import init as init_
from rig.cli.main import main
from rig.plan.load import load_plan
from rig.plan.preflight_checks import errors
from tests.new_bench.test_first_model import MASS_KG, STIFFNESS_N_PER_M, driven
from tests.plan.test_own_dbc import DBC

VALID = ' SG_ ForceOk : 40|1@0+ (1,0) [0|1] "" SENSOR\n SG_ Setpoint'
CYLINDER = 'BO_ 300 CELL: 8 SENSOR\n SG_ Force : 0|16@1- (0.1,0) [0|0] "daN" CONTROL\n\nBO_ 400'
NO_FORCE = ("--applied-force", "none", "--load-cell", "none")
FACTS = ("--mass-kg", "24", "--length-at-rest-m", "0.36", "--stiffness-n-per-m", "9000")


@pytest.fixture
def rig(tmp_path, monkeypatch):
    (tmp_path / "my.dbc").write_text(
        DBC.replace(" SG_ Setpoint", VALID).replace("BO_ 400", CYLINDER)
    )
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        given = ["rig", "init", "--dbc", "my.dbc", "--out", "my.yaml", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", given)
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    return call


def test_what_is_written_passes_the_check(rig, tmp_path, capsys):
    assert rig(*FACTS, "--applied-force", "CELL.Force", "--channel", "can3") == 0
    shown = capsys.readouterr().out
    assert "height: SENSOR_1.Travel" in shown
    assert "Next, with the bench at rest: `rig zero my.yaml --length-m 0.36`" in shown
    plan = load_plan(tmp_path / "my.yaml")
    assert not errors(plan)
    assert plan.config.bus.channel == "can3"
    assert plan.config.model == "my_model.yaml"
    assert plan.config.signals.applied_force.signal == "Force"
    assert rig(*FACTS) == 2
    assert "--out my.yaml: exists, expected a new file" in capsys.readouterr().err


def test_all_forces_of_unclear_place_are_listed_with_their_comments(rig, tmp_path, capsys):
    text = (tmp_path / "my.dbc").read_text()
    other = ' SG_ ForceB : 16|16@1- (0.1,0) [0|0] "daN" CONTROL\n\nBO_ 400'
    text = text.replace('"daN" CONTROL\n\nBO_ 400', f'"daN" CONTROL\n{other}')
    number = re.search(r"BO_ (\d+) CELL", text)[1]
    (tmp_path / "my.dbc").write_text(f'{text}\nCM_ SG_ {number} ForceB "from pressures";\n')
    assert rig(*FACTS) == 2
    said = capsys.readouterr().err
    assert "these are forces" in said
    assert "CELL.Force" in said
    assert "CELL.ForceB (from pressures)" in said


def test_where_a_force_acts_is_asked_for_before_anything_is_written(rig, tmp_path, capsys):
    assert rig(*FACTS) == 2
    assert "CELL.Force is a force, and it is not clear where it acts" in capsys.readouterr().err
    assert not (tmp_path / "my.yaml").exists()
    assert rig(*FACTS, "--load-cell", "none", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["unclear_forces"] == ["CELL.Force"]
    assert set(found["signals"]) == {"height", "temperature"}
    assert found["free_length_m"] == pytest.approx(0.36 + 24.0 * 9.81 / 9000.0)


def test_the_temperature_is_the_one_that_is_named(rig, tmp_path):
    assert rig(*FACTS, *NO_FORCE, "--temperature", "SENSOR_1.OilTemp") == 0
    assert load_plan(tmp_path / "my.yaml").config.signals.temperature.signal == "OilTemp"
    for file in ("my.yaml", "my_model.yaml"):
        (tmp_path / file).unlink()
    assert rig(*FACTS, *NO_FORCE, "--temperature", "none") == 0
    bench = load_plan(tmp_path / "my.yaml").config.signals.bench
    assert "temperature" not in {quantity.key for quantity in bench}


def test_a_free_length_of_a_drawing_is_taken(rig, tmp_path):
    assert rig(*FACTS, *NO_FORCE, "--free-length-m", "0.412") == 0
    (strut,) = load_plan(tmp_path / "my.yaml").model.struts
    assert strut.free_length_m == 0.412
    assert "0.412   # as stated" in (tmp_path / "my_model.yaml").read_text()


def test_a_free_length_replaces_the_length_at_rest(rig, tmp_path, capsys):
    at = FACTS.index("--length-at-rest-m")
    facts = (*FACTS[:at], *FACTS[at + 2 :], *NO_FORCE)
    assert rig(*facts, "--free-length-m", "0.412") == 0
    assert load_plan(tmp_path / "my.yaml").model.struts[0].free_length_m == 0.412
    assert "--length-m LENGTH" in capsys.readouterr().out


BETWEEN = 'CM_ SG_ 300 Force "Load cell between cylinder and carriage";\n'


def test_a_load_cell_at_the_cylinder_measures_the_applied_force(rig, tmp_path, capsys):
    text = (tmp_path / "my.dbc").read_text()
    (tmp_path / "my.dbc").write_text(text + BETWEEN)
    assert rig(*FACTS, "--json") == 0
    signals = json.loads(capsys.readouterr().out)["signals"]
    assert signals["applied_force"]["signal"] == "Force"
    assert "load_cell_force" not in signals


def test_a_load_cell_of_which_nothing_says_where_it_is_is_left_to_the_user(rig, tmp_path, capsys):
    text = (tmp_path / "my.dbc").read_text()
    (tmp_path / "my.dbc").write_text(text + 'CM_ SG_ 300 Force "Load cell, see the sheet";\n')
    assert rig(*FACTS) == 2
    assert "--load-cell CELL.Force for one in the strut" in capsys.readouterr().err


def test_a_force_that_suits_both_places_is_mapped_to_the_one_that_is_named(rig, tmp_path, capsys):
    text = (tmp_path / "my.dbc").read_text()
    (tmp_path / "my.dbc").write_text(text.replace("SG_ Force", "SG_ ShockInput"))
    assert rig(*FACTS) == 2
    assert "CELL.ShockInput is a force" in capsys.readouterr().err
    assert rig(*FACTS, "--applied-force", "CELL.ShockInput", "--load-cell", "CELL.ShockInput") == 2
    assert "--load-cell CELL.ShockInput: is the applied force" in capsys.readouterr().err
    assert rig(*FACTS, "--applied-force", "CELL.ShockInput") == 0
    signals = load_plan(tmp_path / "my.yaml").config.signals
    assert signals.applied_force.signal == "ShockInput"
    assert [quantity.key for quantity in signals.bench if "force" in quantity.key] == [
        "applied_force"
    ]


def test_what_options_leave_open_is_named(rig, capsys):
    for number in range(0, len(FACTS), 2):
        assert rig(*FACTS[:number], *FACTS[number + 2 :], *NO_FORCE) == 2
        said = capsys.readouterr().err
        assert FACTS[number] in said
        assert ": required" in said
    # All that is missing is named at once.
    assert rig(*NO_FORCE) == 2
    said = capsys.readouterr().err
    assert all(option in said for option in FACTS[::2])


def test_in_a_terminal_it_asks(rig, tmp_path, monkeypatch):
    answers = iter(["24", "0.36", "9000"])
    monkeypatch.setattr(init_.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(
        init_.typer, "prompt", lambda text, **_: "a" if "force" in text else next(answers)
    )
    assert rig() == 0
    assert load_plan(tmp_path / "my.yaml").config.signals.applied_force.message == "CELL"


def test_stiffness_and_damping_of_a_recording(rig, tmp_path, capsys):
    t_s = np.arange(0.0, 20.0, 0.002)
    height_m, force_n = driven(t_s)
    table = np.column_stack([t_s, height_m, force_n])
    np.savetxt(
        "sweep.csv", table, delimiter=",", header="t_s,height_m,applied_force_n", comments=""
    )
    assert rig(*FACTS[:4], "--applied-force", "CELL.Force", "--run", "sweep.csv", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["stiffness_n_per_m"] == pytest.approx(STIFFNESS_N_PER_M, rel=1e-3)
    model = load_plan(tmp_path / "my.yaml").model
    (body,) = model.skeleton.bodies
    assert body.mass_kg == MASS_KG
    assert "from sweep.csv, explaining 100% of it" in (tmp_path / "my_model.yaml").read_text()
    assert rig(*FACTS, "--run", "sweep.csv") == 2


def test_a_dyno_needs_a_load_cell(rig, tmp_path, capsys):
    facts, path = FACTS[2:], tmp_path / "my.dbc"
    text = path.read_text()
    second = ' SG_ Other : 16|16@1- (0.1,0) [0|0] "daN" CONTROL\n\nBO_ 400'
    path.write_text(text.replace("\nBO_ 400", second, 1))
    assert rig(*facts, "--dyno") == 2
    assert "--dyno: requires the force in the strut: --load-cell" in capsys.readouterr().err
    assert rig(*facts, "--dyno", "--load-cell", "CELL.Force") == 0
    for file in ("my.yaml", "my_model.yaml"):
        (tmp_path / file).unlink()
    path.write_text(text)  # whose only force it is
    assert rig(*facts, "--dyno") == 0
    (strut,) = load_plan(tmp_path / "my.yaml").model.struts
    assert strut.free_length_m == 0.36  # no weight rests on it
    plan = load_plan(tmp_path / "my.yaml")
    assert plan.config.prescribed_motion is not None
    assert not errors(plan)


def test_what_a_dbc_holds_that_cannot_be_read_is_listed(rig, tmp_path, capsys):
    path = tmp_path / "my.dbc"
    overlap = (
        "BO_ 500 OTHER: 8 CONTROL\n"
        ' SG_ A : 0|9@1+ (1,0) [0|0] "" SENSOR\n SG_ B : 8|8@1+ (1,0) [0|0] "" SENSOR\n\nBA_DEF_ '
    )
    path.write_text(path.read_text().replace("BA_DEF_ ", overlap, 1))
    assert rig(*FACTS, *NO_FORCE) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Passed over in my.dbc: message OTHER: The signals" in shown


def test_signals_in_units_that_are_not_understood_are_listed(rig, tmp_path, capsys):
    path = tmp_path / "my.dbc"
    path.write_text(path.read_text().replace('(0.1,0) [0|0] "daN"', '(1,0) [0|0] "10N"'))
    assert rig(*FACTS) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Not considered: CELL.Force, whose unit is not understood" in shown
