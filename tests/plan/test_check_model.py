"""What the check finds in a model before a bench moves."""

import pytest
import yaml

from dart_model.spec import MODELS
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check


def findings(folder, damping_n_s_per_m=100.0, effects=(), **keys):
    model = yaml.safe_load((MODELS / "reference.yaml").read_text())
    model["struts"][0] |= {"damping_n_s_per_m": damping_n_s_per_m, "effects": list(effects)}
    return findings_of(folder, model, **keys)


def findings_of(folder, model, **keys):
    (folder / "model.yaml").write_text(yaml.safe_dump(model))
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    (folder / "rig.yaml").write_text(yaml.safe_dump(config | {"model": "model.yaml"} | keys))
    return {item.what: item for item in check(load_plan(folder / "rig.yaml"))}


def blow_off(lost_damping_n_s_per_m, knee_velocity_m_per_s=0.2):
    parameters = {
        "lost_damping_n_s_per_m": lost_damping_n_s_per_m,
        "knee_velocity_m_per_s": knee_velocity_m_per_s,
    }
    return {"name": "blow_off_damping", "parameters": parameters}


@pytest.mark.parametrize("effects", [[], [blow_off(60.0)]])
def test_a_damper_that_dissipates_is_no_finding(tmp_path, effects):
    assert "damper of strut" not in findings(tmp_path, effects=effects)


def test_a_damper_that_drives_at_high_speed_is_a_warning(tmp_path):
    # 100 v - 125 (v - 0.2) is zero at 1 m/s.
    found = findings(tmp_path, effects=[blow_off(125.0)])["damper of strut"]
    assert found.severity is Severity.WARNING
    speed = float(found.text.removeprefix("drives the motion from ").split(" m/s")[0])
    assert 1.0 < speed < 1.35


@pytest.mark.parametrize(("inertia", "is_found"), [(None, True), ([1.0, 1.0, 1.0], False)])
def test_a_body_that_rotates_without_moments_of_inertia_is_a_warning(tmp_path, inertia, is_found):
    model = yaml.safe_load((MODELS / "reference.yaml").read_text())
    arm = {"name": "arm", "mass_kg": 1.0, "joint": {"type": "revolute", "axis": [0, 1, 0]}}
    arm |= {} if inertia is None else {"inertia_kg_m2": inertia}
    model["skeleton"]["bodies"].append(arm)
    assert ("inertia" in findings_of(tmp_path, model)) is is_found


@pytest.mark.parametrize(("interface", "has_none"), [("virtual", True), ("socketcan", False)])
def test_the_bus_load_of_an_interface_without_a_bit_rate_says_so(tmp_path, interface, has_none):
    found = findings(tmp_path, bus={"interface": interface, "channel": "bench"})
    assert "% of 1 Mbit/s" in found["bus load"].text
    assert ("has no bit rate" in found["bus load"].text) is has_none


def test_a_height_limit_that_is_wider_than_any_travel_is_a_warning(tmp_path):
    row = {"value": "height_m", "low": -183.0, "high": 18.0, "action": "safe"}
    found = findings(tmp_path, supervision={"limits": [row]})["limits of strut"]
    assert found.severity is Severity.WARNING
    assert "expected a limit on measured_height_m" in found.text
    travel = {"value": "measured_height_m", "low": 0.3, "high": 0.5, "action": "safe"}
    found = findings(tmp_path, supervision={"limits": [row, travel]})["limits of strut"]
    assert found.severity is Severity.OK
