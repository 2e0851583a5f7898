"""Skeletons from URDF, SDF, SKEL and MJCF are the same model as the one written inline."""

from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from dart_model.errors import ModelError
from dart_model.plant import DartPlant
from dart_model.spec import ModelSpec, load_model

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'

URDF = f"""<?xml version="1.0"?>
<robot name="bench">
  <link name="base"/>
  <link name="body">
    <inertial><origin xyz="0 0 0"/><mass value="10"/>{INERTIA}</inertial>
  </link>
  <joint name="guide" type="prismatic">
    <parent link="base"/><child link="body"/><axis xyz="0 0 1"/>
    <limit lower="-10" upper="10" effort="100000" velocity="100"/>
  </joint>
</robot>
"""

SDF = """<?xml version="1.0"?>
<sdf version="1.4">
  <model name="bench">
    <link name="body">
      <inertial><mass>10</mass>
        <inertia><ixx>1</ixx><ixy>0</ixy><ixz>0</ixz><iyy>1</iyy><iyz>0</iyz><izz>1</izz></inertia>
      </inertial>
    </link>
    <joint name="guide" type="prismatic">
      <parent>world</parent><child>body</child>
      <axis><xyz>0 0 1</xyz></axis>
    </joint>
  </model>
</sdf>
"""

SKEL = """<?xml version="1.0"?>
<skel version="1.0">
  <world name="world">
    <physics><time_step>0.001</time_step><gravity>0 0 -9.81</gravity></physics>
    <skeleton name="bench">
      <body name="body">
        <transformation>0 0 0 0 0 0</transformation>
        <inertia><mass>10</mass><offset>0 0 0</offset></inertia>
      </body>
      <joint type="prismatic" name="guide">
        <parent>world</parent><child>body</child>
        <axis><xyz>0 0 1</xyz></axis>
      </joint>
    </skeleton>
  </world>
</skel>
"""

MJCF = """<mujoco model="bench">
  <compiler angle="radian"/>
  <worldbody>
    <body name="body" pos="0 0 0">
      <joint name="guide" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="10" diaginertia="1 1 1"/>
      <geom type="sphere" size="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""

FILES = {"bench.urdf": URDF, "bench.sdf": SDF, "bench.skel": SKEL, "bench.xml": MJCF}

INLINE = "{bodies: [{name: body, mass_kg: 10, joint: {type: prismatic, parent: world}}]}"


def model(folder: Path, skeleton: str) -> ModelSpec:
    path = folder / "model.yaml"
    path.write_text(
        f"""
name: bench
skeleton: {skeleton}
struts:
  - name: strut
    between: [world, body]
    free_length_m: 0.5
    stiffness_n_per_m: 500
    damping_n_s_per_m: 100
""",
        "utf-8",
    )
    return load_model(path)


@pytest.mark.parametrize("name", FILES)
def test_a_file_gives_the_same_motion_as_the_inline_bodies(name, tmp_path):
    (tmp_path / name).write_text(FILES[name], "utf-8")
    plants = [DartPlant(model(tmp_path, text)) for text in (f"{{file: {name}}}", INLINE)]
    after: list[list[tuple[float, float]]] = []
    for plant in plants:
        state = plant.init([0.42])
        for _ in range(50):
            state = plant.step(plant.load(state, (20.0,), (30.0,), 20.0), 1e-3, (30.0,))
        after.append(state.struts)
    assert after[0][0] == pytest.approx(after[1][0], abs=1e-12)


DAMPED = URDF.replace('<limit lower="-10"', '<dynamics damping="40"/><limit lower="-10"')
SPRUNG = SKEL.replace(
    "<axis><xyz>0 0 1</xyz></axis>",
    "<axis><xyz>0 0 1</xyz><dynamics><spring_stiffness>300</spring_stiffness></dynamics></axis>",
)


@pytest.mark.parametrize(
    ("name", "text", "own_force_n"),
    [("bench.urdf", DAMPED, -40.0 * 0.7), ("bench.skel", SPRUNG, -300.0 * 0.42)],
)
def test_a_spring_or_damper_of_the_joint_itself_acts(name, text, own_force_n, tmp_path):
    """DART's own forces depend on the state, which it must then be told at every stage."""
    (tmp_path / name).write_text(text, "utf-8")
    found: list[float] = []
    for skeleton in (f"{{file: {name}}}", INLINE):
        plant = DartPlant(model(tmp_path, skeleton))
        moving = plant.init([0.42], [0.7])
        plant.load(plant.init([0.1]), (0.0,), (0.0,), 20.0)
        found.append(plant.load(moving, (0.0,), (0.0,), 20.0).accelerations_m_per_s2[0])
    assert found[0] == pytest.approx(found[1] + own_force_n / 10.0, rel=1e-6)


@pytest.mark.parametrize(("name", "text"), [("bench.urdf", DAMPED), ("bench.skel", SPRUNG)])
def test_a_spring_or_damper_of_the_joint_itself_is_in_the_bias_force(name, text, tmp_path):
    (tmp_path / name).write_text(text, "utf-8")
    plant = DartPlant(model(tmp_path, f"{{file: {name}}}"))
    q, v, step = np.array([0.3]), np.array([0.7]), np.array([0.1])
    by_q = plant.mechanics(q + step, v).bias - plant.mechanics(q, v).bias
    by_v = plant.mechanics(q, v + step).bias - plant.mechanics(q, v).bias
    assert (by_q < -1e-3) | (by_v < -1e-3)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_dart_cannot_read_is_one_line(name, tmp_path):
    (tmp_path / name).write_text(FILES[name][:60], "utf-8")
    with pytest.raises(InputError) as caught:
        DartPlant(model(tmp_path, f"{{file: {name}}}"))
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"bench\.urdf: skeleton\.file: no such file"):
        DartPlant(model(tmp_path, "{file: bench.urdf}"))


def test_an_unknown_format_is_named(tmp_path):
    (tmp_path / "bench.obj").write_text("", "utf-8")
    with pytest.raises(InputError, match=r"suffix '\.obj': expected \.urdf, \.sdf"):
        DartPlant(model(tmp_path, "{file: bench.obj}"))


@pytest.mark.parametrize("file", ["/etc/passwd", "../bench.urdf", "a/../../bench.urdf"])
def test_a_file_outside_the_folder_is_refused(file, tmp_path):
    with pytest.raises(
        InputError, match=r"skeleton.*expected a path inside the model's own folder"
    ):
        model(tmp_path, f"{{file: {file}}}")


def test_a_body_whose_mass_dart_would_not_read_is_refused(tmp_path):
    text = MJCF.replace('<geom type="sphere" size="0.1"/>', "")
    (tmp_path / "bench.xml").write_text(text, "utf-8")
    with pytest.raises(InputError, match=r"bench\.xml: body body: no geom, expected one"):
        DartPlant(model(tmp_path, "{file: bench.xml}"))


def test_a_body_that_is_not_in_the_file_is_refused(tmp_path):
    (tmp_path / "bench.urdf").write_text(URDF.replace('"body"', '"piston"'), "utf-8")
    with pytest.raises(InputError, match=r"strut strut: between 'body': expected one of.*piston"):
        DartPlant(model(tmp_path, "{file: bench.urdf}"))


def test_a_skeleton_without_a_joint_that_moves_is_refused(tmp_path):
    (tmp_path / "bench.urdf").write_text(URDF.replace('type="prismatic"', 'type="fixed"'), "utf-8")
    with pytest.raises(InputError, match="no joint that moves"):
        DartPlant(model(tmp_path, "{file: bench.urdf}"))


def included(*names: str) -> str:
    """The MJCF file, with further files included."""
    elements = "".join(f'<include file="{name}"/>' for name in names)
    return MJCF.replace("<worldbody>", f"{elements}<worldbody>")


def only_includes(*names: str) -> str:
    return f"<mujoco>{''.join(f'<include file={name!r}/>' for name in names)}</mujoco>"


def ring(text: str, body: str) -> str:
    """A file in which `body` and a further one carry each other."""
    axis = "<axis><xyz>0 0 1</xyz></axis>"
    other = (
        f'<{body} name="other"/><joint name="back" type="prismatic">'
        f"<parent>body</parent><child>other</child>{axis}</joint>"
    )
    return text.replace("<parent>world", "<parent><!-- -->other").replace(
        "</joint>", f"</joint>{other}"
    )


SUFFIXES = (".xml", ".mjcf", ".sdf", ".skel")

ENDLESS = {
    "itself": {"bench.xml": included("bench.xml")},
    "nothing": {"bench.xml": included("")},
    "another name of itself": {"bench.xml": included("bench.xml?x")},
    "each other": {"bench.xml": included("a.xml"), "a.xml": only_includes("bench.xml")},
    "twice": {"bench.xml": included("a.xml", "a.xml"), "a.xml": only_includes()},
    "in a ring": {
        "bench.mjcf": included("parts/a.xml"),
        "parts/a.xml": only_includes("parts/b.xml"),
        "parts/b.xml": only_includes("parts/a.xml"),
    },
    "above": {"bench.xml": included("../bench.xml")},
    "by a document type": {
        "bench.xml": '<!DOCTYPE mujoco [<!ATTLIST include file CDATA "x.xml">]>' + included()
    },
    "SDF, one body": {"bench.sdf": SDF.replace("<parent>world", "<parent>body")},
    "SDF, two bodies": {"bench.sdf": ring(SDF, "link")},
    "SDF, a name in pieces": {"bench.sdf": SDF.replace("<parent>world", "<parent>body<!-- -->x")},
    "SKEL, one body": {"bench.skel": SKEL.replace("<parent>world", "<parent>body")},
    "SKEL, two bodies": {"bench.skel": ring(SKEL, "body")},
}


@pytest.mark.parametrize("files", ENDLESS.values(), ids=ENDLESS)
def test_what_dart_would_read_without_end_is_refused_before(files, tmp_path, monkeypatch):
    parsers = dict.fromkeys(SUFFIXES, lambda _: pytest.fail("DART was given the file"))
    monkeypatch.setattr("dart_model.plant.skeleton._PARSERS", parsers)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    with pytest.raises(ModelError) as caught:
        DartPlant(model(tmp_path, f"{{file: {next(iter(files))}}}"))
    assert str(tmp_path) in str(caught.value)
    assert ", expected" in str(caught.value) or ": expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_include_each_other_once_are_read(tmp_path):
    body = MJCF[MJCF.index("<worldbody>") : MJCF.index("</mujoco>")]
    (tmp_path / "bench.xml").write_text(only_includes("parts/a.xml"), "utf-8")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "a.xml").write_text(only_includes("parts/b.xml"), "utf-8")
    (tmp_path / "parts" / "b.xml").write_text(f"<mujoco>{body}</mujoco>", "utf-8")
    plant = DartPlant(model(tmp_path, "{file: bench.xml}"))
    assert plant.init([0.42]).struts[0][0] == pytest.approx(0.42)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("bench.sdf", "<mass>10", "<mass>ten"),
        ("bench.sdf", "<mass>10", "<mass>1e999"),
        ("bench.skel", "<mass>10", "<mass>ten"),
        ("bench.xml", 'size="0.1"', 'size="small"'),
        ("bench.xml", 'mass="10"', 'mass="ten"'),
        ("bench.urdf", 'mass value="10"', 'mass value="ten"'),
    ],
)
def test_a_value_that_is_no_number_is_one_line(name, old, new, tmp_path):
    (tmp_path / name).write_text(FILES[name].replace(old, new), "utf-8")
    with pytest.raises(ModelError, match="expected") as caught:
        DartPlant(model(tmp_path, f"{{file: {name}}}"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('mass value="10"', 'mass value="ten"', "mass [ten] is not a float"),
        ("</robot>", "", "XML_ERROR"),
        ('<child link="body"/>', '<child link="bodi"/>', "child link [bodi] of joint"),
    ],
)
def test_the_parsers_reason_is_in_the_line_and_not_beside_it(old, new, reason, tmp_path, capfd):
    assert old in URDF
    (tmp_path / "bench.urdf").write_text(URDF.replace(old, new), "utf-8")
    with pytest.raises(ModelError) as caught:
        DartPlant(model(tmp_path, "{file: bench.urdf}"))
    assert reason in str(caught.value)
    assert capfd.readouterr().err == ""
