"""A model that is an FMU: bench, diagnosis, FMU, and the same bench again."""

import dataclasses
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from dart_model.plant import DartPlant
from dart_model.plant.admitted_programs import require_admission
from dart_model.spec import MODELS, EffectSpec, load_model
from rig.demo.cases import DemoOptions
from rig.demo.story import draw_effect, run_story
from rig.diagnosis.files import diagnose_runs
from rig.fmu.component import bench_component, strut_component
from rig.fmu.export import export_fmu
from rig.fmu.import_fmu import FMU_FILE, MODEL_FILE, import_fmu
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import check
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import UndeclaredEffect
from tests.fmu.driver import written
from tests.fmu.specimens import with_effects

SEED = 3
DURATION_S = 8.0
DISCRETE = 'causality="output" variability="discrete"'
SETTLED = 500
"""Ticks after which the observer follows."""


@pytest.fixture(autouse=True)
def settings(tmp_path_factory, monkeypatch):
    """Settings of a user who imported nothing."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("settings")))


def run_beside(folder, model, effects, excitation=3):
    """A run of a model in lockstep with the story's bench; and its virtual force (RMS)."""
    bench = load_bench_config(CONFIGS / "story_bench.yaml")
    components = [c.model_copy(update={"seed": excitation}) for c in bench.applied_force.components]
    force = bench.applied_force.model_copy(update={"components": tuple(components)})
    changed = {"undeclared_effects": effects, "seed": excitation, "applied_force": force}
    ready = load_plan(CONFIGS / "story.yaml", duration_s=DURATION_S)
    with_bench(
        ready.with_model(model),
        bench.model_copy(update=changed),
        folder,
        lockstep=True,
    )
    column = read_run(folder).steps.column("strut.virtual_force_n").to_numpy()
    return float(np.sqrt(np.mean(np.asarray(column)[SETTLED:] ** 2)))


def imported(folder, component, spec, version, mass_kg=None):
    path = written(folder, component, version, spec)
    out = folder / f"imported_{path.stem}"
    import_fmu(path, None, mass_kg, out)
    return load_model(out / MODEL_FILE)


@pytest.mark.long
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_corrected_model_comes_back_as_an_fmu(tmp_path, version):
    """A bench with an effect that nobody declared is diagnosed; the corrected model becomes an FMU,
    and the FMU the model: the virtual force is what noise alone leaves."""
    story = run_story(
        SEED,
        tmp_path / "story",
        DemoOptions(True, DURATION_S, stop=lambda: False, watch=lambda *_: None),
        chapter=lambda _: None,
        diagnosis_progress=lambda _what, _share: None,
    )
    before_n, after_n = story.virtual_force_rms_n
    corrected = load_model(tmp_path / "story" / "diagnosis" / "corrected.yaml")
    nominal = load_model(MODELS / "bench.yaml")
    floor_n = run_beside(tmp_path / "floor", nominal, ())
    effect = (draw_effect(SEED)[1],)
    bench = imported(tmp_path, bench_component(corrected), corrected, version)
    strut = imported(
        tmp_path, strut_component(corrected, corrected.struts[0]), corrected, version, 10.0
    )
    for name, model in (("bench", bench), ("strut", strut)):
        there_n = run_beside(tmp_path / name, model, effect)
        assert there_n == pytest.approx(after_n, rel=1e-6)
        assert there_n < 1.1 * floor_n
        assert there_n < 0.2 * before_n


@pytest.mark.long
def test_a_defective_fmu_is_run_replayed_checked_and_diagnosed(tmp_path):
    """An FMU with a Maxwell element stands for the model; its bench damps by the square as well."""
    own = {"stiffness_n_per_m": 800.0, "relaxation_time_s": 0.05}
    lacking = {"damping_n_s2_per_m2": 150.0}
    nominal = load_model(MODELS / "bench.yaml")
    spec = nominal.with_effects("strut", [EffectSpec(name="maxwell", parameters=own)])
    effects = (
        UndeclaredEffect.model_validate({"name": "maxwell", "strut": "strut", "parameters": own}),
        UndeclaredEffect.model_validate(
            {"name": "quadratic_damping", "strut": "strut", "parameters": lacking}
        ),
    )
    model = imported(tmp_path, strut_component(spec, spec.struts[0]), spec, "3.0", 10.0)
    before_n = run_beside(tmp_path / "run", model, effects, 1)
    run_beside(tmp_path / "held_out", model, effects, 2)
    assert replay(tmp_path / "run").different == 0
    ready = load_plan(CONFIGS / "story.yaml").with_model(model)
    assert {finding.severity.value for finding in check(ready)} <= {"ok", "note", "warning"}
    result = diagnose_runs(
        [tmp_path / "run"], model, [tmp_path / "held_out"], tmp_path / "found", lambda *_: None
    )
    found = result.diagnosis
    assert found.verdict == "explained"
    assert [item.name for item in found.effects] == ["quadratic_damping"]
    (value,) = found.effects[0].parameters.values()
    assert value.value == pytest.approx(150.0, rel=1e-3)
    # On the FMU itself, in free run.
    assert found.held_out.height_rmse_m.after < 1.1 * found.noise_floor.height_rmse_m
    assert found.held_out.height_rmse_m.before > 100.0 * found.noise_floor.height_rmse_m
    corrected = load_model(tmp_path / "found" / "corrected.yaml")
    assert run_beside(tmp_path / "after", corrected, effects) < 0.05 * before_n


def test_an_fmu_moves_a_body_as_the_law_inside_it_does(tmp_path):
    """As a bench and as a strut, in both versions: the plant's own figures, to rounding."""
    spec = with_effects("end_stops", "bouc_wen")
    plant = DartPlant(spec)
    models = [
        imported(tmp_path, made, spec, version, mass_kg)
        for version in ("2.0", "3.0")
        for made, mass_kg in (
            (bench_component(spec), None),
            (strut_component(spec, spec.struts[0]), 10.0),
        )
    ]
    theirs = moved(plant)
    for model in models:
        assert moved(DartPlant(model)) == pytest.approx(theirs, rel=1e-9, abs=1e-12)


def moved(plant):
    state = plant.init([0.38])
    rows = []
    for k in range(400):
        loaded = plant.load(state, (5.0,), (30.0 * np.sin(0.02 * k),), 20.0)
        state = plant.step(loaded, 1e-3, (30.0 * np.sin(0.02 * (k + 1)),))
        rows.append((*state.struts[0], loaded.forces_n[0]))
    return np.array(rows)


def test_the_past_can_be_computed_again(tmp_path):
    """A plant's answers depend on its arguments alone, also with an FMU that has states."""
    spec = with_effects("maxwell", "backlash")
    plant = DartPlant(imported(tmp_path, bench_component(spec), spec, "2.0"))
    states = [plant.init([0.38])]
    for _ in range(200):
        states.append(plant.step(plant.load(states[-1], (0.0,), (0.0,), 20.0), 1e-3, (0.0,)))
    again = plant.step(plant.load(states[50], (0.0,), (0.0,), 20.0), 1e-3, (0.0,))
    assert again == states[51]
    numbers = plant.numbers(states[120])
    assert plant.state_of(numbers, states[120].t_s) == states[120]


def test_variables_of_other_names_are_mapped_and_signs_turned(tmp_path):
    spec = with_effects("quadratic_damping")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), "2.0", spec)
    names = {'"height_m"': '"x_rel"', '"velocity_m_per_s"': '"v_rel"', '"force_n"': '"F_damper"'}
    foreign = changed(path, tmp_path / "foreign.fmu", names)
    with pytest.raises(InputError, match="expected --mapping FILE"):
        import_fmu(foreign, None, 10.0, tmp_path / "none")
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("{height: x_rel, velocity: v_rel, force: -F_damper}")
    import_fmu(foreign, mapping, 10.0, tmp_path / "out")
    (unit,) = DartPlant(load_model(tmp_path / "out" / MODEL_FILE)).mockups
    (own,) = DartPlant(
        imported(tmp_path, strut_component(spec, spec.struts[0]), spec, "2.0", 10.0)
    ).mockups
    given = (0.0, 0.31, 0.2, 0.0, 20.0, [])
    assert unit.force(*given) == -own.force(*given)
    mapping.write_text("{height: x_rel, velocity: v_rel, force: F_spring}")
    with pytest.raises(InputError, match="force: no variable 'F_spring'"):
        import_fmu(foreign, mapping, 10.0, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def changed(path, out, changes):
    """An FMU whose description has other words."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        for item in old.namelist():
            text = old.read(item)
            if item == "modelDescription.xml":
                for before, after in changes.items():
                    assert before.encode() in text
                    text = text.replace(before.encode(), after.encode())
            new.writestr(item, text)
    return out


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """A strut called `it`, of FMI 2.0."""
    spec = with_effects("none")
    component = dataclasses.replace(strut_component(spec, spec.struts[0]), identifier="it")
    return written(tmp_path_factory.mktemp("fmu"), component, "2.0", spec)


def test_a_model_file_alone_makes_no_program_run(tmp_path, monkeypatch):
    """Another user, or another machine: the FMU has to be imported there, by hand."""
    spec = with_effects("none")
    model = imported(tmp_path, bench_component(spec), spec, "3.0")
    DartPlant(model)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "somebody_else"))
    with pytest.raises(InputError, match="not imported on this machine"):
        DartPlant(model)


def test_an_fmu_that_was_changed_does_not_run(tmp_path):
    spec = with_effects("none")
    model = imported(tmp_path, bench_component(spec), spec, "3.0")
    path = model.folder / FMU_FILE
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(InputError, match="not imported on this machine"):
        DartPlant(model)


@pytest.mark.parametrize(
    ("version", "changes", "line"),
    [
        ("2.0", {"<ModelExchange": "<!--", "</ModelExchange>": "-->"}, "Co-Simulation alone"),
        ("2.0", {"canGetAndSetFMUstate": "canBeInstantiatedOnlyOncePerProcess"}, "only once"),
        ("2.0", {'causality="output" variability="continuous"': DISCRETE}, "a discrete variable"),
        ("2.0", {"fmiModelDescription ": "somethingElse "}, "is no FMU"),
        ("2.0", {"{": "{0"}, "does not start .*name and GUID: expected"),
        ("3.0", {"{": "{0"}, "does not start .*token: expected"),
    ],
)
def test_what_cannot_be_a_model_is_said(tmp_path, version, changes, line):
    spec = with_effects("none")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), version, spec)
    with pytest.raises(InputError, match=line):
        import_fmu(changed(path, tmp_path / "it.fmu", changes), None, 10.0, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("is_absolute", [False, True])
def test_no_library_from_outside_the_archive_is_loaded(tmp_path, monkeypatch, version, is_absolute):
    """A library that does what is wanted, at a place of which a foreign file can know."""
    spec = with_effects("none")
    component = bench_component(spec)
    path = written(tmp_path, component, version, spec)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # where the FMU is extracted
    with zipfile.ZipFile(path) as archive:
        (name,) = [name for name in archive.namelist() if name.startswith("binaries/")]
        library = tmp_path / f"outside{Path(name).suffix}"
        library.write_bytes(archive.read(name))
    outside = str(library.with_suffix("")) if is_absolute else "../../../outside"
    changes = {f'modelIdentifier="{component.identifier}"': f'modelIdentifier="{outside}"'}
    foreign = changed(path, tmp_path / "it.fmu", changes)
    with pytest.raises(InputError, match=f"modelIdentifier '{outside}': expected a C identifier"):
        import_fmu(foreign, None, None, tmp_path / "out")
    with pytest.raises(InputError, match="not imported on this machine"):
        require_admission(foreign.read_bytes(), foreign)


@pytest.mark.parametrize("interface", ["ModelExchange", "CoSimulation"])
@pytest.mark.parametrize(
    "identifier", ["../it", "a/b", "a\\b", "/it", "C:it", "..", "", " it", "it ", "1t", "ït", "i-t"]
)
def test_an_identifier_is_one_of_c_in_every_interface(fmu, tmp_path, interface, identifier):
    old, new = (f'<{interface} modelIdentifier="{name}"' for name in ("it", identifier))
    foreign = changed(fmu, tmp_path / "it.fmu", {old: new})
    with pytest.raises(InputError, match="expected a C identifier") as caught:
        import_fmu(foreign, None, 10.0, tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_an_identifier_with_a_zero_byte_is_no_description(fmu, tmp_path):
    old, new = (f'modelIdentifier="{name}"' for name in ("it", "it\0"))
    with pytest.raises(InputError, match="is no FMU"):
        import_fmu(changed(fmu, tmp_path / "it.fmu", {old: new}), None, 10.0, tmp_path / "out")


@pytest.mark.parametrize(
    "name", ["../outside", "binaries/../../outside", "/outside", "a\\..\\outside", "C:outside"]
)
def test_no_member_of_the_archive_is_written_outside(fmu, tmp_path, monkeypatch, name):
    foreign = tmp_path / "foreign.fmu"
    foreign.write_bytes(fmu.read_bytes())
    with zipfile.ZipFile(foreign, "a") as archive:
        archive.writestr(name, "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(InputError, match="outside': expected files in the folder of the FMU"):
        import_fmu(foreign, None, 10.0, tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == {"foreign.fmu"}


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive at all", bytes(range(256)) * 9])
def test_what_is_no_archive_is_said(tmp_path, content):
    path = tmp_path / "it.fmu"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is no FMU"):
        import_fmu(path, None, 10.0, tmp_path / "out")


@pytest.mark.parametrize(
    ("bench", "mass_kg", "line"),
    [(False, None, "expected --mass-kg")],
)
def test_a_mass_is_given_where_it_is_missing(tmp_path, bench, mass_kg, line):
    spec = with_effects("none")
    made = bench_component(spec) if bench else strut_component(spec, spec.struts[0])
    path = written(tmp_path, made, "2.0", spec)
    with pytest.raises(InputError, match=line):
        import_fmu(path, None, mass_kg, tmp_path / "out")


def test_a_virtual_force_accelerates_the_right_mass(tmp_path):
    """Also where an effect makes more of the applied force, or adds to the mass."""
    spec = with_effects("input_gain", "added_mass")
    model = imported(tmp_path, bench_component(spec), spec, "2.0")
    assert model.struts[0].fmu.mass_kg == pytest.approx(30.0, rel=1e-9)
    ours, theirs = DartPlant(model), DartPlant(spec)
    rows = []
    for plant in (ours, theirs):
        state = plant.init([0.3])
        for _ in range(200):
            state = plant.step(plant.load(state, (20.0,), (3.0,), 20.0), 1e-3, (3.0,))
        rows.append(state.struts[0])
    assert rows[0] == pytest.approx(rows[1], rel=1e-9)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_point_that_an_fmu_refuses_spoils_no_other(tmp_path, version):
    spec = with_effects("end_stops", "maxwell")
    (unit,) = DartPlant(imported(tmp_path, bench_component(spec), spec, version)).mockups
    good = (0.1, 0.31, 0.2, 5.0, 20.0, [0.01])
    first = unit.force(*good)
    assert np.isnan(unit.force(0.1, 1e308, 1e308, 0.0, 20.0, [1e308]))
    assert unit.force(*good) == first


def test_a_model_with_an_fmu_is_not_exported(tmp_path):
    spec = with_effects("none")
    model = imported(tmp_path, bench_component(spec), spec, "3.0")
    for bench in (True, False):
        with pytest.raises(InputError, match="has an FMU, expected one without"):
            export_fmu(model, tmp_path / "it.fmu", "2.0", None, bench)


def test_an_import_that_fails_admits_nothing(tmp_path):
    spec = with_effects("none")
    path = written(tmp_path, bench_component(spec), "2.0", spec)
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("{height: strut.height_m, velocity: strut.velocity_m_per_s, force: nowhere}")
    with pytest.raises(InputError):
        import_fmu(path, mapping, 10.0, tmp_path / "out")
    with pytest.raises(InputError, match="not imported on this machine"):
        require_admission(path.read_bytes(), path)


@pytest.mark.parametrize(
    ("mapping", "line"),
    [
        ("{height: height_m, velocity: height_m, force: force_n}", "has two roles"),
        ("{height: -height_m, velocity: velocity_m_per_s, force: force_n}", "different signs"),
        ("{height: height_m, velocity: velocity_m_per_s}", "force and acceleration"),
        ("{height: height_m, speed: velocity_m_per_s, force: force_n}", "speed"),
        ("[1, 2]", "mapping.yaml"),
        (
            "{height: height_m, velocity: velocity_m_per_s, force: force_n, "
            "parameters: {force_n: 1}}",
            "expected a parameter",
        ),
    ],
)
def test_a_mapping_that_contradicts_itself_is_said(tmp_path, mapping, line):
    spec = with_effects("none")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), "2.0", spec)
    file = tmp_path / "mapping.yaml"
    file.write_text(mapping)
    with pytest.raises(InputError, match=line):
        import_fmu(path, file, 10.0, tmp_path / "out")


def test_an_integer_is_no_parameter(tmp_path):
    """Value references of FMI 2.0 are counted by type: one of an integer is another real's."""
    spec = with_effects("none")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), "2.0", spec)
    own = (
        '<ScalarVariable name="n" valueReference="6" causality="parameter" variability="tunable">'
        '<Integer start="1"/></ScalarVariable></ModelVariables>'
    )
    foreign = changed(path, tmp_path / "it.fmu", {"</ModelVariables>": own})
    file = tmp_path / "mapping.yaml"
    roles = "height: height_m, velocity: velocity_m_per_s, force: force_n"
    file.write_text(f"{{{roles}, parameters: {{n: 0}}}}")
    with pytest.raises(InputError, match="single real number"):
        import_fmu(foreign, file, 10.0, tmp_path / "out")


def test_a_height_that_begins_nowhere_begins_at_zero(tmp_path):
    spec = with_effects("none")
    path = written(tmp_path, strut_component(spec, spec.struts[0]), "2.0", spec)
    foreign = changed(
        path, tmp_path / "it.fmu", {'<Real unit="m" start="0.5"': '<Real unit="m" start="INF"'}
    )
    model = import_fmu(foreign, None, 10.0, tmp_path / "out")
    assert model.struts[0].free_length_m == 0.0


def test_nothing_is_left_of_a_refused_fmu(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    test_what_is_no_archive_is_said(tmp_path, b"PK")
    assert not list(tmp_path.glob("rig-fmu-*"))
