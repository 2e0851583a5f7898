"""A model file is read as it is meant, or refused in one line that names what is wrong."""

import contextlib
import re
from collections.abc import Callable
from copy import deepcopy

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text
from dart_model.effects import CATALOGUE
from dart_model.spec import (
    MODELS,
    BodySpec,
    EffectSpec,
    InlineSkeleton,
    JointSpec,
    ModelSpec,
    ModelTolerance,
    StrutSpec,
    dump_model,
    load_model,
    parse_model,
)

TEXT = """
name: reference
gravity_m_per_s2: 9.81
skeleton:
  bodies:
    - {name: body, mass_kg: 10.0, joint: {type: prismatic, axis: [0, 0, 1], parent: world}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: 0.5
    stiffness_n_per_m: 500.0
    damping_n_s_per_m: 100.0
    effects: []
"""

NUMBERS = st.floats(-1e6, 1e6)
POSITIVE = st.floats(1e-6, 1e6)


@st.composite
def effects(draw: st.DrawFn) -> EffectSpec:
    law = CATALOGUE[draw(st.sampled_from(sorted(CATALOGUE)))]
    parameters = {item.name: draw(st.floats(item.low, item.high)) for item in law.parameters}
    return EffectSpec(name=law.name, parameters=parameters)


PERCENTAGES = st.none() | st.decimals("0.0001", 1000, places=4).map(lambda x: f"{x:f} %")


@st.composite
def tolerances(draw: st.DrawFn) -> ModelTolerance:
    shares = {
        name: draw(PERCENTAGES)
        for name in ("mass_kg", "stiffness_n_per_m", "damping_n_s_per_m", "input_gain")
    }
    return ModelTolerance.model_validate({**shares, "preload_n": draw(st.none() | POSITIVE)})


@st.composite
def models(draw: st.DrawFn) -> ModelSpec:
    bodies: list[BodySpec] = []
    for index in range(draw(st.integers(1, 4))):
        parent = draw(st.sampled_from(["world", *[body.name for body in bodies]]))
        kind = draw(st.sampled_from(["prismatic", "revolute", "ball", "free"]))
        offset = draw(st.tuples(NUMBERS, NUMBERS, NUMBERS))
        joint = JointSpec(type=kind, axis=(0.0, 3.0, 4.0), parent=parent, offset_m=offset)
        inertia = draw(st.none() | st.tuples(POSITIVE, POSITIVE, POSITIVE))
        mass = draw(POSITIVE)
        body = BodySpec(name=f"b{index}", mass_kg=mass, joint=joint, inertia_kg_m2=inertia)
        bodies.append(body)
    names = ["world", *[body.name for body in bodies]]
    struts = [
        StrutSpec(
            name=f"s{index}",
            between=draw(st.permutations(names).map(lambda order: (order[0], order[1]))),
            free_length_m=draw(NUMBERS),
            stiffness_n_per_m=draw(POSITIVE),
            damping_n_s_per_m=draw(POSITIVE),
            effects=tuple(draw(st.lists(effects(), max_size=2))),
        )
        for index in range(draw(st.integers(1, 3)))
    ]
    return ModelSpec(
        name="drawn",
        gravity_m_per_s2=draw(NUMBERS),
        skeleton=InlineSkeleton(bodies=tuple(bodies)),
        struts=tuple(struts),
        applied_force_body=draw(st.none() | st.sampled_from(names[1:])),
        tolerance=draw(st.none() | tolerances()),
    )


@settings(max_examples=50, deadline=None)
@given(spec=models())
def test_what_is_written_is_read_back_as_the_same(spec):
    assert parse_model(dump_model(spec), "drawn.yaml") == spec


@pytest.mark.parametrize("path", sorted(MODELS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_models_are_valid_and_named_after_their_files(path):
    spec = load_model(path)
    assert spec.name == path.stem
    assert parse_model(dump_model(spec), "copy", path.parent) == spec


def test_the_seed_is_the_published_defective_model():
    (strut,) = load_model(MODELS / "reference.yaml").struts
    assert (strut.free_length_m, strut.stiffness_n_per_m, strut.damping_n_s_per_m) == (
        0.5,
        500,
        100,
    )


def test_effects_of_a_strut_are_replaced():
    spec = parse_model(TEXT, "reference.yaml")
    effect = EffectSpec(name="preload", parameters={"force_n": 3.0})
    changed = spec.with_effects("strut", [effect])
    assert changed.strut("strut").effects == (effect,)
    assert changed.with_effects("strut", []) == spec
    with pytest.raises(InputError, match="strut 'other': expected one of strut"):
        spec.with_effects("other", [])


def test_tolerances_are_shares_and_written_as_percentages():
    known = (
        "tolerance: {mass_kg: 0.1 %, stiffness_n_per_m: 20%, damping_n_s_per_m: 40 %, "
        "preload_n: 5.0, input_gain: 7 %}"
    )
    spec = parse_model(TEXT + known, "reference.yaml")
    assert spec.tolerance == ModelTolerance.model_construct(
        mass_kg=0.001, stiffness_n_per_m=0.2, damping_n_s_per_m=0.4, preload_n=5.0, input_gain=0.07
    )
    assert yaml.safe_load(dump_model(spec))["tolerance"] == {
        "mass_kg": "0.1 %",
        "stiffness_n_per_m": "20 %",
        "damping_n_s_per_m": "40 %",
        "preload_n": 5.0,
        "input_gain": "7 %",
    }


def test_a_model_without_tolerances_has_none():
    spec = parse_model(TEXT, "reference.yaml")
    assert spec.tolerance is None
    assert "tolerance" not in dump_model(spec)
    some = parse_model(TEXT + "tolerance: {mass_kg: 1 %}", "reference.yaml").tolerance
    assert some == ModelTolerance.model_construct(mass_kg=0.01)


def refused(text: str) -> str:
    """The message, after checking that it is one line that names the file."""
    with pytest.raises(InputError) as caught:
        parse_model(text, "folder/reference.yaml")
    message = str(caught.value)
    assert message.startswith("folder/reference.yaml:")
    assert "\n" not in message
    assert len(message) < 1500
    return message


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("name: reference", "", "name: is missing"),
        ("name: reference", "name: [1]", "name: [1]: expected a text"),
        ("name: reference", "name: '1 & 2'", "name: '1 & 2': string should match pattern"),
        ("9.81", "heavy", "gravity_m_per_s2: 'heavy': expected a number alone"),
        ("9.81", ".nan", "gravity_m_per_s2: nan: expected a finite number"),
        ("mass_kg: 10.0", "mass_kg: -1", "skeleton.bodies.0.mass_kg: -1: expected more than 0"),
        ("mass_kg: 10.0", "mass_kg: .inf", "skeleton.bodies.0.mass_kg: inf: expected a fin"),
        (
            "mass_kg: 10.0",
            "mass: 10.0",
            "0.mass: unknown key, did you mean mass_kg?",
        ),
        ("prismatic", "sliding", "joint.type: 'sliding': expected one of prismatic, revolute"),
        ("[0, 0, 1]", "[0, 0]", "joint.axis: 2 item(s), expected more"),
        ("[0, 0, 1]", "[0, 0, 0]", "joint.axis: [0.0, 0.0, 0.0]: expected a direction"),
        ("parent: world", "parent: wall", "joint.parent 'wall': expected world"),
        ("{name: body,", "{name: world,", "body 'world': expected another name"),
        ("[world, body]", "[world, world]", "struts.0: between ['world', 'world']: expected two"),
        (
            "[world, body]",
            "[world, wheel]",
            "strut strut: between 'wheel': expected one of world, b",
        ),
        ("500.0", "-500.0", "struts.0.stiffness_n_per_m: -500.0: expected 0 or more"),
        ("500.0", "true", "struts.0.stiffness_n_per_m: True: expected a number"),
        (
            "free_length_m",
            "free_length_mm",
            "free_length_mm: unknown key, did you mean free_length_m?",
        ),
        ("effects: []", "effects: [{name: magic}]", "effects.0: name 'magic': expected one of"),
        (
            "effects: []",
            "effects: [{name: preload, parameters: {force_n: 1, offset: 2}}]",
            "effects.0: parameters of preload: unknown 'offset', expected force_n",
        ),
        (
            "effects: []",
            "effects: [{name: preload}]",
            "effects.0: parameters of preload: 'force_n' is missing",
        ),
        (
            "effects: []",
            "effects: [{name: coulomb_friction, parameters: {coulomb_force_n: -2.5, "
            "rounding_velocity_m_per_s: 0.01}}]",
            "effects.0: parameters of coulomb_friction: coulomb_force_n = -2.5: "
            "expected 0 to 1e+12 N",
        ),
        (
            "effects: []",
            "effects: [{name: power_damping, parameters: {force_at_1_m_per_s_n: 3, exponent: 9}}]",
            "effects.0: parameters of power_damping: exponent = 9.0: expected 0.3 to 4",
        ),
        ("9.81", "9.81\ntolerance: {mass_kg: 0.1}", "tolerance.mass_kg: 0.1: expected a percent"),
        ("9.81", "9.81\ntolerance: {mass_kg: 0.0 %}", "tolerance.mass_kg: '0.0 %': expected a per"),
        ("9.81", "9.81\ntolerance: {mass_kg: -1 %}", "tolerance.mass_kg: '-1 %': expected a perc"),
        ("9.81", "9.81\ntolerance: {mass_kg: 2000 %}", "such as 20 %"),
        ("9.81", "9.81\ntolerance: {mass_kg: true}", "tolerance.mass_kg: True: expected a percen"),
        (
            "9.81",
            "9.81\ntolerance: {preload_n: 5 %}",
            "tolerance.preload_n: '5 %': expected a num",
        ),
        ("9.81", "9.81\ntolerance: {preload_n: 0}", "tolerance.preload_n: 0: expected more than 0"),
        (
            "9.81",
            "9.81\ntolerance: {mass: 1 %}",
            "tolerance.mass: unknown key, did you mean mass_kg?",
        ),
        ("gravity_m_per_s2: 9.81", "applied_force_body: wheel", "applied_force_body 'wheel': exp"),
        (
            "gravity_m_per_s2: 9.81",
            "gravity: 9.81",
            "gravity: unknown key, did you mean gravity_m_per_s2?",
        ),
        (
            "gravity_m_per_s2: 9.81",
            "name: again",
            "line 3 is no valid YAML: key 'name' occurs twice",
        ),
        ("gravity_m_per_s2: 9.81", "1: 2", "key 1: expected a name"),
        ("gravity_m_per_s2: 9.81", "a: &x 1\nb: *x", "aliases are not accepted"),
        ("gravity_m_per_s2: 9.81", "a: !!python/object:os.system x", "is no valid YAML"),
        ("gravity_m_per_s2: 9.81", "a: [", "is no valid YAML"),
        ("gravity_m_per_s2: 9.81", "a: 2020-99-99", "is no valid YAML"),
        ("gravity_m_per_s2: 9.81", "{[1]: 2}: 3", "is no valid YAML"),
    ],
)
def test_a_mistake_is_one_line_that_names_it(old, new, expected):
    text = TEXT.replace(old, new)
    assert text != TEXT
    assert expected in refused(text)


@pytest.mark.parametrize("what", ["body", "strut"])
def test_a_name_that_stands_twice_is_refused(what):
    data = yaml.safe_load(TEXT)
    items = data["skeleton"]["bodies"] if what == "body" else data["struts"]
    items.append(deepcopy(items[0]))
    assert f"{what} '{what}' occurs 2 times" in refused(yaml.safe_dump(data, sort_keys=False))


def test_parents_stand_before_children():
    data = yaml.safe_load(TEXT)
    child = {"name": "child", "mass_kg": 1, "joint": {"type": "prismatic", "parent": "body"}}
    data["skeleton"]["bodies"].insert(0, child)
    assert "parents stand before children" in refused(yaml.safe_dump(data))


@pytest.mark.parametrize("text", ["", "[]", "3", "reference", "- a\n- b"])
def test_what_is_no_mapping_is_refused(text):
    assert "expected keys and values" in refused(text)


def test_errors_beyond_the_first_are_counted():
    text = TEXT.replace(" 500.0", " x").replace(" 100.0", " y")
    assert "(and 1 more error: " in refused(text)


def test_deep_nesting_is_refused():
    refused("a: " + "[" * 5000)


def test_many_bodies_are_refused():
    data = yaml.safe_load(TEXT)
    bodies = data["skeleton"]["bodies"]
    bodies += [{**deepcopy(bodies[0]), "name": f"b{index}"} for index in range(256)]
    assert "skeleton.bodies" in refused(yaml.safe_dump(data))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"\xff\xfe", "byte 0 is not UTF-8"),
        (b"a" * (4 * 1024 * 1024 + 1), "larger than 4194304 bytes"),
        (None, "no such file"),
    ],
)
def test_a_file_that_cannot_be_text_is_named(content, expected, tmp_path):
    path = tmp_path / "model.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=expected) as caught:
        load_model(path)
    assert str(caught.value).startswith(str(path))


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_text(tmp_path)


def message_of(work: Callable[[], object]) -> str:
    """Message of the refusal, empty if the work was done."""
    with contextlib.suppress(InputError):
        work()
        return ""
    with pytest.raises(InputError) as caught:
        work()
    return str(caught.value)


@settings(max_examples=300, deadline=None)
@given(text=st.text(max_size=60))
def test_any_text_is_read_or_refused_in_one_line(text):
    assert "\n" not in message_of(lambda: parse_mapping(text, "any.yaml"))


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_a_mutated_model_is_read_or_refused_in_one_line(data):
    place = data.draw(st.integers(0, len(TEXT) - 1))
    length = data.draw(st.integers(0, 20))
    text = TEXT[:place] + data.draw(st.text(max_size=5)) + TEXT[place + length :]
    assert re.fullmatch(
        r"(mutated\.yaml: .*)?", message_of(lambda: parse_model(text, "mutated.yaml"))
    )
