"""What is wrong with a damper against its master, with dampers of equations of their own."""

import json
from functools import cache

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.dyno.characterise import ForceRecord, characterise_record
from rig.dyno.faults import name_faults
from rig.dyno.master import cycle_of, master_of, with_compliance, with_play
from tests.dyno.population import (
    FAULTS,
    SCATTER,
    Damper,
    characterised,
    record,
    replace,
    short,
)
from tests.dyno.test_characteristics import written
from tests.dyno.test_comparison import state


@cache
def master():
    return master_of(characterised(Damper(), 0))


@pytest.mark.long
@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "changed damping"])
def test_a_fault_is_named(fault):
    rng = np.random.default_rng(7)
    damper = FAULTS[fault](Damper().scattered(rng), rng)
    naming = name_faults(characterised(damper, 7), master(), SCATTER)
    assert short([item.name for item in naming.named], naming.is_good) == fault


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "name", "size"),
    [
        ({"friction_n": 60.0}, "seal friction", 42.0),
        ({"play_m": 5e-4}, "play", 0.5),
        ({"gas_n": 110.0}, "gas pressure", 0.5),
    ],
)
def test_its_size_is_told(changed, name, size):
    naming = name_faults(characterised(replace(Damper(), **changed), 3), master(), SCATTER)
    (found,) = naming.named
    assert found.name == name
    assert found.size.value == pytest.approx(size, rel=0.15)


def test_without_scatter_a_small_change_is_one():
    """What another damper of the batch may have by chance, the same damper cannot."""
    weak = characterised(replace(Damper(), gas_n=200.0), 4)
    assert name_faults(weak, master(), SCATTER).is_good
    (found,) = name_faults(weak, master(), 0.001).named
    assert found.name == "gas pressure"


def test_a_rigid_column_and_no_play_change_nothing():
    good = master()
    cycle = cycle_of(max(good.characteristics.steps, key=lambda step: step.peak_speed_m_per_s))
    velocity, height = (column[-720:] for column in (cycle.velocity_m_per_s, cycle.height_m))
    stiff = with_compliance(good, cycle, np.array([1e11]))[0]
    assert stiff == pytest.approx(good.damping(velocity), abs=2.0)
    held = good.gas(height) - good.friction_n * np.sign(velocity) + good.damping(velocity)
    assert with_play(good, cycle, np.array([0.0]))[0] == pytest.approx(held)


def test_play_takes_its_travel_at_every_change_of_sign():
    """In the gap there is no force, and the machine moves on by the play less what the gas does."""
    good = master()
    step = max(good.characteristics.steps, key=lambda step: step.peak_speed_m_per_s)
    cycle, play = cycle_of(step), 1e-3
    force = with_play(good, cycle, np.array([play]))[0]
    velocity, height = (column[-720:] for column in (cycle.velocity_m_per_s, cycle.height_m))
    free = float(good.rebound.speed(np.maximum(good.gas(height) - good.friction_n, 0.0)).max())
    inside = (force == 0.0) & (velocity > 0.0)
    travelled = float(np.sum((velocity[inside] - free) * cycle.interval_s))
    assert travelled == pytest.approx(play, rel=0.15)


@pytest.mark.long
def test_the_command_names_it(tmp_path):
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    written(good, (*record(Damper(), np.random.default_rng(1)),))
    written(bad, (*record(replace(Damper(), friction_n=70.0), np.random.default_rng(2)),))
    junit, out = tmp_path / "j.xml", tmp_path / "out"
    given = ["characterise", str(bad), "--master", str(good), "--junit", str(junit)]
    ended = CliRunner().invoke(app, [*given, "--out", str(out)])
    assert ended.exit_code == 1, ended.output
    assert "seal friction" in " ".join(ended.output.split())
    found = json.loads((out / "characteristics.json").read_text())["records"][0]["against_master"]
    assert found["named"][0]["name"] == "seal friction"
    assert "Seal friction" in (out / "report.html").read_text()
    assert 'failures="1"' in junit.read_text()
    again = tmp_path / "again.csv"
    written(again, (*record(Damper(), np.random.default_rng(3)),))
    ended = CliRunner().invoke(app, ["characterise", str(again), "--master", str(good)])
    assert ended.exit_code == 0, ended.output


def test_a_master_of_another_test_is_refused():
    with pytest.raises(InputError, match="expected the same test as the master's"):
        name_faults(characterised(Damper(), 1), master_of(state(1)), SCATTER)


def test_a_master_without_a_slow_step_is_refused():
    fast = state(1)
    damper = fast.damper._replace(gas_force_n=None)
    with pytest.raises(InputError, match="5 mm/s or less"):
        master_of(type(fast)(**{**vars(fast), "damper": damper}))


def test_what_was_not_compared_does_not_pass():
    """A record without the fast steps says nothing of what is wrong there."""
    slow = characterised(Damper(), 5)
    part = type(slow)(**{**vars(slow), "steps": slow.steps[:4]})
    naming = name_faults(part, master(), SCATTER)
    assert naming.is_good
    assert not naming.passes
    assert "not compared: ±25 mm at 0.4 m/s" in naming.words()


def test_a_size_beyond_all_that_are_tried_is_that_at_least():
    naming = name_faults(characterised(replace(Damper(), play_m=0.012), 3), master(), SCATTER)
    found = naming.named[0].size if naming.named else None
    assert found is None or found.high == float("inf")
    assert not naming.passes


def test_a_force_of_the_wrong_sign_is_refused():
    t_s, height_m, force_n = record(Damper(), np.random.default_rng(1))
    wrong = characterise_record(ForceRecord("wrong", t_s, height_m, -force_n))
    with pytest.raises(InputError, match="gives energy"):
        master_of(wrong)
    with pytest.raises(InputError, match="gives energy"):
        name_faults(wrong, master(), SCATTER)
