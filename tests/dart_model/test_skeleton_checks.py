"""Skeleton files that would end DART, and the program with it, are refused before it sees them."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.errors import ModelError
from dart_model.plant import DartPlant
from dart_model.skeleton_checks import refuse_fatal
from tests.dart_model.test_skeleton_files import FILES, MJCF, SDF, SKEL, model

VISUAL = (
    "<visual name='v'><pose>0 0 0 0 0 0</pose>"
    "<geometry><box><size>1 1 1</size></box></geometry></visual>"
)
SHAPE = (
    "<visualization_shape><transformation>0 0 0 0 0 0</transformation>"
    "<geometry><ellipsoid><size>1 1 1</size></ellipsoid></geometry></visualization_shape>"
)
FULL_SDF = (
    SDF.replace("<inertial>", "<pose>0 0 0.1 0 0 0</pose><inertial><pose>0 0 0 0 0 0</pose>")
    .replace("</inertial>", f"</inertial>{VISUAL}")
    .replace("<link", "<pose>0 0 0 0 0 0</pose><link")
)
FULL_SKEL = SKEL.replace("</inertia>", f"</inertia>{SHAPE}").replace(
    "<axis>", "<init_pos>0.1</init_pos><axis>"
)
FULL_MJCF = (
    MJCF.replace("<worldbody>", '<option gravity="0 0 -9.81" wind="0 0 0"/><worldbody>')
    .replace('axis="0 0 1"', 'axis="0 0 1" pos="0 0 0" range="-1 1"')
    .replace('size="0.1"', 'size="0.1" quat="1 0 0 0" rgba="1 0 0 1"')
    .replace("<geom", '<site name="s" euler="0 0 0" pos="0 0 0"/><geom')
)
FULL = {"bench.sdf": FULL_SDF, "bench.skel": FULL_SKEL, "bench.xml": FULL_MJCF}

# File, what stands before a vector, the vector, and how many numbers it has.
VECTORS = [
    ("bench.sdf", "<pose>", "0 0 0.1 0 0 0", 6),
    ("bench.sdf", "<xyz>", "0 0 1", 3),
    ("bench.sdf", "<size>", "1 1 1", 3),
    ("bench.skel", "<transformation>", "0 0 0 0 0 0", 6),
    ("bench.skel", "<gravity>", "0 0 -9.81", 3),
    ("bench.skel", "<offset>", "0 0 0", 3),
    ("bench.skel", "<xyz>", "0 0 1", 3),
    ("bench.skel", "<size>", "1 1 1", 3),
    ("bench.skel", "<init_pos>", "0.1", 1),
    ("bench.xml", 'gravity="', "0 0 -9.81", 3),
    ("bench.xml", 'wind="', "0 0 0", 3),
    ("bench.xml", 'axis="', "0 0 1", 3),
    ("bench.xml", 'diaginertia="', "1 1 1", 3),
    ("bench.xml", 'pos="', "0 0 0", 3),
    ("bench.xml", 'range="', "-1 1", 2),
    ("bench.xml", 'euler="', "0 0 0", 3),
    ("bench.xml", 'quat="', "1 0 0 0", 4),
    ("bench.xml", 'rgba="', "1 0 0 1", 4),
]


@pytest.mark.parametrize("name", FILES)
def test_a_right_file_passes(name, tmp_path):
    (tmp_path / name).write_text(FULL.get(name, FILES[name]), "utf-8")
    plant = DartPlant(model(tmp_path, f"{{file: {name}}}"))
    assert plant.coordinates == 1


finite = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("skeletons")


@given(
    vector=st.sampled_from(VECTORS),
    numbers=st.lists(finite, max_size=20),
    space=st.sampled_from([" ", "  ", "\t", "\n"]),
)
@settings(max_examples=400)
def test_a_vector_has_as_many_numbers_as_dart_has_room_for(folder, vector, numbers, space):
    name, before, right, count = vector
    assert before + right in FULL[name]
    path = folder / name
    text = space.join(map(repr, numbers))
    path.write_text(FULL[name].replace(before + right, before + text, 1), "utf-8")
    if len(numbers) == count:
        refuse_fatal(path)
        return
    with pytest.raises(ModelError) as caught:
        refuse_fatal(path)
    assert str(caught.value).startswith(f"{path}: ")
    expected = "expected one number" if count == 1 else f"expected {count} numbers"
    assert str(caught.value).endswith(expected)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("word", ["one", "nan", "inf", "1e999", "1_0", "0x1", "1,5", "\u0661"])
def test_a_word_that_is_no_number_is_refused(tmp_path, word):
    (tmp_path / "bench.xml").write_text(MJCF.replace('pos="0 0 0"', f'pos="0 {word} 0"'), "utf-8")
    with pytest.raises(ModelError, match=r"bench\.xml: body pos: '0 .* 0': expected 3 numbers"):
        refuse_fatal(tmp_path / "bench.xml")


def test_a_file_that_is_included_is_checked(tmp_path):
    (tmp_path / "bench.xml").write_text('<mujoco><include file="a.xml"/></mujoco>', "utf-8")
    (tmp_path / "a.xml").write_text(MJCF.replace('pos="0 0 0"', 'pos="0 0 0 0 0"'), "utf-8")
    with pytest.raises(ModelError, match=r"a\.xml: body pos: '0 0 0 0 0': expected 3 numbers"):
        refuse_fatal(tmp_path / "bench.xml")


def skel_shape(content):
    return SKEL.replace("</inertia>", f"</inertia><collision_shape>{content}</collision_shape>")


FATAL = {
    "a site of the world": ("bench.xml", MJCF.replace("<worldbody>", "<worldbody><site/>")),
    "an unknown mesh": ("bench.xml", MJCF.replace('size="0.1"', 'size="0.1" mesh="x"')),
    "SDF, no geometry": ("bench.sdf", SDF.replace("</inertial>", "</inertial><visual/>")),
    "no geometry": ("bench.skel", skel_shape("")),
    "an empty geometry": ("bench.skel", skel_shape("<geometry/>")),
    "an unknown shape": ("bench.skel", skel_shape("<geometry><torus/></geometry>")),
    "a missing mesh": (
        "bench.skel",
        skel_shape("<geometry><mesh><file_name>x.dae</file_name></mesh></geometry>"),
    ),
    "no joint": ("bench.skel", SKEL[: SKEL.index("<joint")] + "</skeleton></world></skel>"),
    "a body without a joint": ("bench.skel", SKEL.replace("<joint", '<body name="b"/><joint')),
    "a body without a name": ("bench.skel", SKEL.replace('<body name="body">', "<body>")),
    "another child": ("bench.skel", SKEL.replace("<child>body", "<child>boddy")),
    "no child": ("bench.skel", SKEL.replace("<child>body</child>", "")),
    "another parent": ("bench.skel", SKEL.replace("<parent>world", "<parent>floor")),
    "another joint": ("bench.skel", SKEL.replace('type="prismatic"', 'type="screw"')),
    "a joint without a type": ("bench.skel", SKEL.replace(' type="prismatic"', "")),
    "a ball's coordinates": (
        "bench.skel",
        SKEL.replace('"prismatic"', '"ball"').replace("<axis>", "<init_vel>1 2</init_vel><axis>"),
    ),
}


@pytest.mark.parametrize(("name", "text"), FATAL.values(), ids=FATAL)
def test_what_would_end_dart_is_one_line(name, text, tmp_path):
    (tmp_path / name).write_text(text, "utf-8")
    with pytest.raises(ModelError) as caught:
        DartPlant(model(tmp_path, f"{{file: {name}}}"))
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)
