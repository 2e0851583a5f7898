"""Bench configurations: what is accepted, and one line for what is not."""

import math
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from rig.simulated_bench.config import BenchConfigError, load_bench_config
from rig.simulated_bench.effects import EFFECT_KINDS

GOOD = """
name: small
masses:
  - {name: body, mass_kg: 10}
struts:
  - name: strut
    between: [world, body]
    free_length_m: 0.5
    spring: {height_m: [0.1, 0.9], force_n: [4e2, -400.0]}
    damper: {velocity_m_per_s: [-1.0, 1.0], force_n: [40.0, -40.0]}
applied_force:
  body: body
  components:
    - {kind: sine, amplitude_n: 10.0, frequency_hz: 1.0}
undeclared_effects:
  - name: bump_stop
    strut: strut
    parameters: {contact_height_m: 0.3, contact_stiffness_n_per_m1_5: 1e5}
transmissions:
  - message: BENCH_MEASUREMENT
    height: {signal: HEIGHT, strut: strut}
"""


def _load(tmp_path: Path, text: str):
    path = tmp_path / "bench.yaml"
    path.write_text(text)
    return load_bench_config(path)


def test_good_file_is_read(tmp_path):
    config = _load(tmp_path, GOOD)
    assert config.masses[0].mass_kg == 10.0
    assert config.struts[0].spring.force_n == (400.0, -400.0)
    assert config.gravity_m_per_s2 == 9.81
    assert config == _load(tmp_path, GOOD)


@pytest.mark.parametrize(
    ("old", "new", "key", "expectation"),
    [
        ("mass_kg: 10", "mass_kg: -10", "masses.0.mass_kg: -10", "expected more than 0"),
        ("mass_kg: 10", "mass_kg: .nan", "masses.0.mass_kg: nan", "finite"),
        ("mass_kg: 10", "mass_kg: ten", "masses.0.mass_kg: 'ten'", "number"),
        ("mass_kg: 10", "mass_kg: true", "masses.0.mass_kg: True", "number"),
        ("mass_kg: 10", "mass: 10", "masses.0.mass: unknown key", "did you mean mass_kg?"),
        ("name: small", "nam: small", "nam: unknown key", "did you mean name?"),
        ("name: small", "name: small\ncolour: red", "colour: unknown key", "one of name"),
        ("name: small", "name: small\nname: large", "key 'name'", "occurs twice"),
        ("[0.1, 0.9]", "[0.9, 0.1]", "struts.0.spring", "increasing"),
        ("[0.1, 0.9]", "[0.1, 0.5, 0.9]", "struts.0.spring", "expected 3"),
        ("[0.1, 0.9]", "[0.1]", "struts.0.spring.height_m", "at least 2"),
        ("[world, body]", "[body, world]", "struts.0.between.0 = 'body'", "expected world"),
        ("[world, body]", "[world]", "struts.0.between: 1 item(s)", "expected more"),
        ("[world, body]", "[world, wheel]", "struts.0.between.1 = 'wheel'", "expected body"),
        ("  body: body", "  body: wheel", "applied_force.body = 'wheel'", "expected body"),
        ("frequency_hz: 1.0", "phase_rad: 1.0", "applied_force.components.0", "frequency_hz"),
        ("kind: sine", "kind: square", "components.0.kind: 'square'", "one of sine, "),
        ("kind: sine", "kind: multisine", "multisine.amplitude_n: unknown key", "one of kind, "),
        ("name: bump_stop", "name: bumper", "undeclared_effects.0", "one of preload"),
        ("    strut: strut\n", "    strut: leg\n", "effects.0.strut = 'leg'", "expected strut"),
        ("contact_height_m: 0.3", "contact_m: 0.3", "contact_m", "contact_height_m"),
        ("contact_height_m: 0.3, ", "", "contact_height_m", "missing"),
        ("m1_5: 1e5", "m1_5: -1e5", "contact_stiffness_n_per_m1_5 = -100000", "above 0"),
        ("strut: strut}", "strut: leg}", "transmissions.0.height.strut = 'leg'", "expected strut"),
        ("    height: {signal: HEIGHT, strut: strut}\n", "", "transmissions.0", "height"),
        ("message: BENCH_MEASUREMENT", "message: BENCH_MEASUREMENT\n    loss_probability: 2.0",
         "transmissions.0.loss_probability: 2.0", "expected 1 or less"),
        ("message: BENCH_MEASUREMENT", "message: BENCH_MEASUREMENT\n    latency_ns: 1.5",
         "transmissions.0.latency_ns: 1.5", "integer"),
        ("name: small", "name: &a small\ndescription: *a", "no valid YAML", "aliases"),
        ("name: small", "name: [small", "no valid YAML", ""),
        ("name: small", "name: \x07", "no valid YAML", ""),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(tmp_path, old, new, key, expectation):
    assert old in GOOD
    with pytest.raises(InputError) as raised:
        _load(tmp_path, GOOD.replace(old, new, 1))
    line = str(raised.value)
    assert "\n" not in line
    assert len(line) < 700
    assert line.startswith(str(tmp_path / "bench.yaml"))
    assert key in line
    assert expectation in line


def test_number_of_further_errors_is_told(tmp_path):
    text = GOOD.replace("mass_kg: 10", "mass_kg: -1").replace("length_m: 0.5", "length_m: -2")
    with pytest.raises(InputError, match=r"masses\.0\.mass_kg.*\(and 1 more error: "):
        _load(tmp_path, text)


@pytest.mark.parametrize("text", ["", "[]", "1", "just text", "a: " + "[" * 3000])
def test_what_is_no_configuration_is_said_in_one_line(tmp_path, text):
    with pytest.raises(InputError, match=r"bench\.yaml: ") as raised:
        _load(tmp_path, text)
    assert "\n" not in str(raised.value)


def test_file_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"no such file|cannot be read"):
        load_bench_config(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=r"no such file|cannot be read"):
        load_bench_config(tmp_path)
    (tmp_path / "huge.yaml").write_bytes(b"#" * 5_000_000)
    with pytest.raises(InputError, match="larger than"):
        load_bench_config(tmp_path / "huge.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\xd8\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        load_bench_config(tmp_path / "binary.yaml")


def test_effects_that_leave_no_mass_or_no_rest(tmp_path):
    lighter = GOOD.replace("name: bump_stop", "name: added_mass")
    start = lighter.index("{contact")
    end = lighter.index("}", start)
    lighter = lighter[:start] + "{mass_kg: -10.0" + lighter[end:]
    with pytest.raises(BenchConfigError, match=r"bench\.yaml: undeclared_effects\.0\.parameters"):
        _load(tmp_path, lighter)
    floating = GOOD.replace("[4e2, -400.0]", "[0.0, 0.0]").replace("name: bump_stop", "name: delay")
    start = floating.index("{contact")
    end = floating.index("}", start)
    floating = floating[:start] + "{delay_s: 0.001" + floating[end:]
    with pytest.raises(BenchConfigError, match=r"bench\.yaml: struts\.0\.initial_height_m"):
        _load(tmp_path, floating)


def _with_file(name: str) -> str:
    old = "kind: sine, amplitude_n: 10.0, frequency_hz: 1.0"
    return GOOD.replace(old, f"kind: file, path: {name}")


def test_force_file_is_read_beside_the_configuration(tmp_path):
    (tmp_path / "force.csv").write_text("t_s,applied_force_n\n0,0\n1,5\n")
    component = _load(tmp_path, _with_file("force.csv")).applied_force.components[0]
    assert component.kind == "file"
    assert component.samples.values.tolist() == [0.0, 5.0]


@pytest.mark.parametrize(
    ("content", "expectation"),
    [
        ("", "expected one column t_s"),
        ("t_s,force\n0,0\n1,1\n", "expected one column applied_force_n"),
        ("t_s,t_s,applied_force_n\n0,0,0\n", "expected one column t_s"),
        ("t_s,applied_force_n\n0,0\n", "at least 2"),
        ("t_s,applied_force_n\n0,0\n1\n", "line 3: 1 values, expected 2"),
        ("t_s,applied_force_n\n0,0\n1,x\n", "line 3: applied_force_n = 'x'"),
        ("t_s,applied_force_n\n0,0\n1,nan\n", "line 3: applied_force_n = 'nan'"),
        ("t_s,applied_force_n\n0,0\n1,1\n1,2\n", "line 4: t_s does not increase"),
        ("t_s,applied_force_n\n\udcff,0\n", "UTF-8"),
    ],
)
def test_force_file_that_is_wrong(tmp_path, content, expectation):
    (tmp_path / "force.csv").write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError) as raised:
        _load(tmp_path, _with_file("force.csv"))
    line = str(raised.value)
    assert "\n" not in line
    assert "applied_force.components.0" in line
    assert "force.csv" in line
    assert expectation in line


@pytest.mark.parametrize("name", ["none.csv", "../force.csv", "/etc/hostname", "."])
def test_force_file_is_missing_or_elsewhere(tmp_path, name):
    with pytest.raises(InputError, match=r"path = |components\.0") as raised:
        _load(tmp_path, _with_file(name))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", EFFECT_KINDS)
def test_every_parameter_has_its_unit_and_sound_bounds(name):
    units = ("_n", "_m", "_s", "_kg", "_rad", "_hz", "_c", "_k", "_m1_5", "_m2", "_m3")
    plain = {"polytropic_exponent", "exponent", "shape", "static_to_coulomb", "gain"}
    for parameter in EFFECT_KINDS[name].parameters:
        assert parameter.name.endswith(units) or parameter.name in plain | {"final_fraction"}
        assert parameter.low < parameter.high
        if parameter.default is not None:
            assert math.isfinite(parameter.default)
            assert parameter.low <= parameter.default <= parameter.high
