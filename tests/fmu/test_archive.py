"""What lies in an FMU, and what its functions answer to a master that errs."""

import os
import re
import subprocess
import sys
import zipfile
from importlib.resources import files
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from dart_model.spec import dump_model, parse_model
from rig.fmu.archive import archive
from rig.fmu.binaries import TARGETS
from rig.fmu.component import bench_component, strut_component
from tests.fmu.driver import got, is_3, loaded, put, stepped, written
from tests.fmu.specimens import DISPLACED_M, with_effects

VERSIONS = ("2.0", "3.0")
STANDARD = Path(fmpy.__file__).parent / "c-code"
"""The headers of the standard's authors, which come with FMPy."""

MASTERS = Path(__file__).parent / "master"
WINE = Path("/usr/lib/wine/wine64")


@pytest.fixture(scope="module")
def everywhere():
    """An FMU of each version with binaries for all systems."""
    spec = with_effects("end_stops", "bouc_wen")
    return {v: archive(bench_component(spec), v, dump_model(spec)) for v in VERSIONS}


def unpacked(content, folder):
    path = folder / "it.fmu"
    path.write_bytes(content)
    with zipfile.ZipFile(path) as zipped:
        zipped.extractall(folder / "it")
    return folder / "it"


def functions_of(version):
    text = (STANDARD / f"fmi{version[0]}Functions.h").read_text()
    return set(re.findall(r"FullName\((fmi\w+)\)", text)) - {"name"}


@pytest.mark.long
@pytest.mark.parametrize("version", VERSIONS)
def test_every_binary_exports_every_function_of_the_standard(everywhere, tmp_path, version):
    folder = unpacked(everywhere[version], tmp_path)
    wanted = functions_of(version)
    assert len(wanted) > 40
    systems = {path.parent.name: path for path in (folder / "binaries").glob("*/*")}
    assert set(systems) == {target.folder(version) for target in TARGETS} - {None}
    for path in systems.values():
        words = set(re.findall(rb"fmi\d[A-Za-z0-9]+", path.read_bytes()))
        assert {name.encode() for name in wanted} <= words, path


@pytest.mark.long
@pytest.mark.parametrize("version", VERSIONS)
def test_the_windows_binary_runs_under_wine(everywhere, tmp_path, version):
    """A master compiled for Windows loads it by its name and steps it: the same bits as Linux."""
    if not WINE.exists():
        pytest.skip("wine64 is not installed")
    folder = unpacked(everywhere[version], tmp_path)
    description = fmpy.read_model_description(str(folder))
    height = next(v for v in description.modelVariables if v.name == "strut.height_m")
    name = "win64" if version == "2.0" else "x86_64-windows"
    (library,) = (folder / "binaries" / name).glob("*.dll")
    master = tmp_path / "master.exe"
    build = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-w"]
    headers = str(files("rig.fmu") / "c")
    source = str(MASTERS / f"master{version[0]}.c")
    subprocess.run([*build, "-I", headers, "-o", str(master), source], check=True)
    asked = [description.guid, str(height.valueReference), repr(DISPLACED_M), "500", "0.001"]
    environment = {**os.environ, "WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"}
    result = subprocess.run(
        [WINE, str(master), f"Z:{library}", *asked],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    subprocess.run(["/usr/lib/wine/wineserver64", "-k"], env=environment, check=False, timeout=60)
    assert result.returncode == 0, result.stderr
    theirs = [float(line) for line in result.stdout.split()]
    t_s = np.arange(501) * 1e-3
    path = tmp_path / "here.fmu"
    path.write_bytes(everywhere[version])
    ours = let_go(path, t_s)
    assert theirs == pytest.approx(ours[1:], rel=1e-12)


def let_go(path, t_s):
    """Heights of the mass under its weight, from `DISPLACED_M`."""
    heights = []
    with loaded(path, {"strut.height_m": DISPLACED_M}) as (instance, places):
        heights.append(got(instance, places, ["strut.height_m"])[0])
        for k in range(len(t_s) - 1):
            instance.doStep(float(t_s[k]), float(t_s[k + 1] - t_s[k]))
            heights.append(got(instance, places, ["strut.height_m"])[0])
    return np.array(heights)


@pytest.mark.parametrize("version", VERSIONS)
def test_the_same_model_gives_the_same_bytes(tmp_path, version):
    spec = with_effects("maxwell")
    first, second = (
        written(tmp_path, bench_component(spec), version, spec).read_bytes() for _ in range(2)
    )
    assert first == second
    other = with_effects("dahl")
    assert token_of(written(tmp_path, bench_component(other), version, other)) != token_of(
        written(tmp_path, bench_component(spec), version, spec)
    )


def token_of(path):
    return fmpy.read_model_description(str(path)).guid


@pytest.mark.parametrize("version", VERSIONS)
def test_sources_and_model_lie_beside_the_binaries(tmp_path, version):
    spec = with_effects("backlash")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), version, spec)
    with zipfile.ZipFile(path) as zipped:
        names = set(zipped.namelist())
        text = zipped.read("resources/model.yaml").decode()
        listed = zipped.read(
            "modelDescription.xml" if version == "2.0" else "sources/buildDescription.xml"
        ).decode()
        code = [zipped.read(name).decode() for name in names if name.endswith((".c", ".h"))]
    assert dump_model(parse_model(text, "it")) == dump_model(spec)
    sources = {name.removeprefix("sources/") for name in names if name.endswith(".c")}
    assert set(re.findall(r'name="(\w+\.c)"', listed)) == sources
    included = {name for text in code for name in re.findall(r'#include "([^"]+)"', text)}
    assert {f"sources/{name}" for name in included} <= names
    assert "documentation/index.html" in names


@pytest.mark.parametrize("version", VERSIONS)
def test_a_state_that_is_put_back_goes_on_as_it_did(tmp_path, version):
    """Also through bytes: internal states, switches and time are all of it."""
    spec = with_effects("end_stops", "bouc_wen")
    path = written(tmp_path, bench_component(spec), version, spec)
    names = ["strut.height_m", "strut.velocity_m_per_s", "strut.force_n"]
    with loaded(path, {"strut.height_m": DISPLACED_M}) as (instance, places):

        def run(begin, end):
            for k in range(begin, end):
                put(instance, places, {"applied_force_n": 30.0 * np.sin(0.01 * k)})
                instance.doStep(k * 1e-3, 1e-3)
            return got(instance, places, names)

        run(0, 150)
        state = instance.getFMUState() if is_3(instance) else instance.getFMUstate()
        data = serialized(instance, state)
        first = run(150, 400)
        (instance.setFMUState if is_3(instance) else instance.setFMUstate)(state)
        assert run(150, 400) == first
        again = restored(instance, data)
        (instance.setFMUState if is_3(instance) else instance.setFMUstate)(again)
        assert run(150, 400) == first
        for one in (state, again):
            (instance.freeFMUState if is_3(instance) else instance.freeFMUstate)(one)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_force_that_is_no_number_is_an_error_of_the_step(tmp_path, version):
    spec = with_effects("bouc_wen")
    path = written(tmp_path, bench_component(spec), version, spec)
    with loaded(path) as (instance, places):
        put(instance, places, {"applied_force_n": float("nan")})
        with pytest.raises(FMICallException):
            instance.doStep(0.0, 1e-3)


def serialized(instance, state):
    if is_3(instance):
        return instance.serializeFMUState(state)
    return instance.serializeFMUstate(state)


def restored(instance, data):
    if is_3(instance):
        return instance.deserializeFMUState(data)
    return instance.deSerializeFMUstate(data)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_reset_instance_begins_anew(tmp_path, version):
    spec = with_effects("bouc_wen")
    path = written(tmp_path, bench_component(spec), version, spec)
    with loaded(path, {"strut.height_m": DISPLACED_M}) as (instance, places):
        instance.doStep(0.0, 0.2)
        first = got(instance, places, ["strut.height_m"])
        instance.reset()
        if not is_3(instance):
            instance.setupExperiment(startTime=0.0)
        put(instance, places, {"strut.height_m": DISPLACED_M})
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        instance.doStep(0.0, 0.2)
        assert got(instance, places, ["strut.height_m"]) == first


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda it, _: put(it, {"x": 100_000}, {"x": 1.0}), id="no such value"),
        pytest.param(lambda it, places: put(it, places, {"strut.force_n": 1.0}), id="an output"),
        pytest.param(lambda it, places: put(it, places, {"strut.height_m": 0.1}), id="a state"),
        pytest.param(lambda it, _: it.doStep(0.0, -1e-3), id="a step back"),
        pytest.param(lambda it, _: it.enterInitializationMode(), id="twice"),
        pytest.param(lambda it, _: got(it, {"x": 100_000}, ["x"]), id="read beyond"),
    ],
)
def test_what_a_master_must_not_do_is_an_error_and_no_crash(tmp_path, version, wrong):
    spec = with_effects("bouc_wen")
    path = written(tmp_path, bench_component(spec), version, spec)
    with loaded(path) as (instance, places):
        with pytest.raises(FMICallException):
            wrong(instance, places)
        instance.doStep(0.0, 1e-3)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_parameter_is_tuned_while_it_runs(tmp_path, version):
    """Damping taken away at 0.1 s: the strut's force loses it at once."""
    spec = with_effects("none")
    path = written(tmp_path, bench_component(spec), version, spec)
    names = ["strut.velocity_m_per_s", "strut.damper.part_n"]
    with loaded(path, {"strut.height_m": DISPLACED_M}) as (instance, places):
        instance.doStep(0.0, 0.1)
        speed, part = got(instance, places, names)
        assert part == pytest.approx(-25.0 * speed)
        assert abs(part) > 1.0
        put(instance, places, {"strut.damping_n_s_per_m": 0.0})
        assert got(instance, places, names) == [speed, 0.0]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_heavier_bench_rests_lower(tmp_path, version):
    """mass_kg is a parameter: the mean height under its weight follows it, m g / k."""
    spec = with_effects("none")
    path = written(tmp_path, bench_component(spec), version, spec)
    t_s = np.arange(0.0, 6.0, 1e-2)
    means = {}
    for mass_kg in (10.0, 12.0):
        with loaded(path, {"mass_kg": mass_kg}) as (instance, places):
            heights = []
            for at_s in t_s:
                instance.doStep(float(at_s), 1e-2)
                heights.append(got(instance, places, ["strut.height_m"])[0])
        means[mass_kg] = heights[-1]
    assert means[10.0] == pytest.approx(0.5 - 10.0 * 9.81 / 500.0, abs=1e-9)
    assert means[12.0] == pytest.approx(0.5 - 12.0 * 9.81 / 500.0, abs=2e-4)


def test_an_input_may_be_held_in_fmi_2(tmp_path):
    """Without slopes an input is held from the beginning of a step, as the standard says."""
    spec = with_effects("none")
    path = written(tmp_path, bench_component(spec), "2.0", spec)
    t_s = np.arange(200) * 1e-3
    force = np.full(200, 25.0)
    sloped = stepped(path, t_s, {"applied_force_n": force}, ["strut.height_m"])["strut.height_m"]
    with loaded(path) as (instance, places):
        held = []
        put(instance, places, {"applied_force_n": 25.0})
        for at_s in t_s[:-1]:
            instance.doStep(float(at_s), 1e-3)
            held += got(instance, places, ["strut.height_m"])
    assert held == sloped[1:].tolist()
