"""Signals of foreign buses, and the configuration that is proposed from them."""

from pathlib import Path

import pytest
import yaml

from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.errors import InputError
from rig.new_bench.proposal import Force, find_force, find_height, unclear_forces
from rig.new_bench.signal_ranking import split_name
from rig.plan.load import load_plan
from rig.plan.preflight_checks import errors
from tests.new_bench.proposing import find_signals, propose
from tests.plan.test_own_dbc import DBC

HEADER = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: SENSOR CONTROL\n\n'
CYCLES = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\n'


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "my.dbc"
    path.write_text(DBC)
    return path


def write(dbc: Path, signals: dict[str, str], statements: str = "") -> Path:
    """A DBC with a message for each signal, whose definition follows its name."""
    messages = [
        f"BO_ {number} M{number}: 8 SENSOR\n SG_ {name} : 0|16@1- {definition} CONTROL\n"
        for number, (name, definition) in enumerate(signals.items(), start=1)
    ]
    dbc.write_text(HEADER + "\n".join(messages) + "\n" + CYCLES + statements)
    return dbc


def test_a_proposal_finds_height_temperature_and_where_to_publish(dbc):
    text = propose(dbc)
    assert yaml.safe_load(text) == {
        "rate_hz": 1000,
        "model": "reference",
        "dbc": "my.dbc",
        "bus": {"interface": "socketcan", "channel": "can0", "bitrate": 500000},
        "signals": {
            "height": {"message": "SENSOR_1", "signal": "Travel"},
            "temperature": {"message": "SENSOR_1", "signal": "OilTemp"},
        },
        "publish": {"force": {"message": "CONTROL_1", "signal": "EstimatedForce"}},
        "observers": {
            "strut": {
                "kind": "kalman",
                # A tenth of a radian an interval of 1 ms, steps of 0.05 mm over the root of 12.
                "filter": {"bandwidth_hz": 15.92, "noise_std_m": 1.443e-5},
            }
        },
        "supervision": {
            "stale_after_s": 0.01,
            "safe_after_s": 0.5,
            "limits": [
                {"value": "measured_rate_m_per_s", "low": -10, "high": 10, "action": "refuse"},
                {"value": "unchanged_s", "high": 1, "action": "hold"},
            ],
        },
    }
    assert "unsafe: {publish_without_valid: true}" in text
    assert "'travel' in its name, in mm, steps of 0.05 mm, every 1 ms" in text


def test_the_rate_is_that_of_the_height(dbc):
    dbc.write_text(DBC.replace("BO_ 288 1;", "BO_ 288 2;"))
    assert yaml.safe_load(propose(dbc))["rate_hz"] == 500


MM = '(0.01,0) [0|300] "mm"'


@pytest.mark.parametrize(
    ("signals", "statements", "height"),
    [
        # A length that is measured elsewhere in a vehicle, faster and finer.
        ({"Odometer": '(0.001,0) [0|65] "km"', "SuspFrnt_L_Actl": MM}, "", "M2.SuspFrnt_L_Actl"),
        ({"ObjectDistance": MM, "WegHinten": '(0.1,0) [0|0] "mm"'}, "", "M2.WegHinten"),
        ({"FuelLevel": MM, "Pos": '(0.1,0) [0|100] "mm"'}, "", "M2.Pos"),
        # Only the comment says it.
        ({"Ch1": MM, "Ch2": MM}, 'CM_ SG_ 2 Ch2 "stroke of the damper";', "M2.Ch2"),
        # Names alike: the faster one.
        ({"Stroke1": MM, "Stroke2": MM}, 'BA_ "GenMsgCycleTime" BO_ 2 5;', "M2.Stroke2"),
        # No word, but a sensor's cycle and step.
        (
            {"Odometer": '(0.001,0) [0|65] "km"', "Dist": MM},
            'BA_ "GenMsgCycleTime" BO_ 2 2;',
            "M2.Dist",
        ),
        # `override` is no ride height, and a quantity may stand before the unit.
        ({"Override": MM, "RideHgt": '(0.01,0) [0|300] "distance:mm"'}, "", "M2.RideHgt"),
    ],
)
def test_the_height_is_what_names_range_and_cycle_say(signals, statements, height, dbc):
    assert find_height(load_database(write(dbc, signals, statements)), None).name == height


def test_a_dbc_without_a_height_is_answered_by_what_to_do(dbc):
    with pytest.raises(InputError, match=r"\(there are M1\.Odometer\): name it with --height"):
        find_height(load_database(write(dbc, {"Odometer": '(0.001,0) [0|65] "km"'})), None)
    with pytest.raises(
        InputError,
        match=r"my\.dbc: no signal has a unit of length, .*M1\.ShockPot, give it its unit",
    ):
        find_height(load_database(write(dbc, {"ShockPot": '(1,0) [0|0] ""'})), None)
    increments = {"Odometer": '(0.001,0) [0|65] "km"', "Pos": '(1,0) [0|0] "inc"'}
    database = load_database(write(dbc, increments))
    with pytest.raises(InputError, match=r"; M2\.Pos has no unit that is known\): name it with"):
        find_height(database, None)
    with pytest.raises(
        InputError,
        match=r"M2\.Pos: has the unit 'inc', .* in a copy of the DBC, in M2: "
        r"`SG_ Pos : 0\|16@1- \(SCALE,0\) \[0\|0\] \"mm\"`, with SCALE in mm per count",
    ):
        find_height(database, "M2.Pos")
    database = load_database(write(dbc, {"ShockPot": MM, "F": '(1,0) [0|0] "10N"'}))
    with pytest.raises(InputError, match=r"`SG_ F : 0\|16@1- .* in N per count"):
        find_force(database, Force.APPLIED, "M2.F")
    database = load_database(write(dbc, {"ShockPot": MM, "Force": '(1,0) [0|0] "N"'}))
    assert find_height(database, "M1.ShockPot").why == "as named"
    with pytest.raises(InputError, match=r"--height M2\.Force: has the unit 'N', .* of length"):
        find_height(database, "M2.Force")
    with pytest.raises(InputError, match=r"no signal 'ShockPit', did you mean ShockPot"):
        find_height(database, "M1.ShockPit")
    with pytest.raises(InputError, match=r"--height ShockPot: expected MESSAGE\.SIGNAL"):
        find_height(database, "ShockPot")


N = '(1,0) [0|0] "N"'


def test_a_force_is_mapped_only_where_it_is_clear_where_it_acts(dbc):
    comment = 'CM_ SG_ 2 F "Force of the cylinder on the carriage";'
    database = load_database(write(dbc, {"Stroke": MM, "F": N}, comment))
    assert find_force(database, Force.APPLIED, None).name == "M2.F"
    assert find_force(database, Force.IN_STRUT, None) is None
    database = load_database(write(dbc, {"Stroke": MM, "DamperLoadCell": N}))
    assert find_force(database, Force.APPLIED, None) is None
    assert find_force(database, Force.IN_STRUT, None).name == "M2.DamperLoadCell"
    database = load_database(write(dbc, {"Stroke": MM, "Force": N, "BrakeForce": N}))
    assert find_force(database, Force.APPLIED, None) is None
    assert find_force(database, Force.IN_STRUT, None) is None
    assert [item.name for item in unclear_forces(database, [])] == ["M2.Force"]
    fast = "".join(f'BA_ "GenMsgCycleTime" BO_ {number} 1;' for number in (1, 2, 3))
    named = {"Stroke": MM, "ForceAct": N, "MeasuredForce": N}
    database = load_database(write(dbc, named, fast))
    assert {item.name for item in unclear_forces(database, [])} == {
        "M2.ForceAct",
        "M3.MeasuredForce",
    }
    write(dbc, {"Stroke": MM, "Force": N, "BrakeForce": N})
    text = propose(dbc)
    assert "# M2.Force: a force; applied_force (on the body) or load_cell_force?" in text
    assert set(yaml.safe_load(text)["signals"]) == {"height"}


def test_several_messages_of_the_bench_leave_the_estimate_to_another_node(dbc):
    text = DBC.replace(
        "BO_ 400",
        "BO_ 300 SENSOR_2: 8 SENSOR\n"
        ' SG_ EstForce : 7|16@0- (0.1,0) [-3000|3000] "N" CONTROL\n\nBO_ 400',
    )
    dbc.write_text(text)
    published = yaml.safe_load(propose(dbc))["publish"]
    assert published == {"force": {"message": "CONTROL_1", "signal": "EstimatedForce"}}


def test_a_message_that_is_not_for_an_estimate_is_left_and_one_of_its_own_is_shown(dbc, tmp_path):
    used = DBC.replace("EstimatedForce", "BrakeForceDemand").replace("BO_ 400", "BO_ 1664")
    dbc.write_text(used)
    text = propose(dbc)
    assert "publish" not in yaml.safe_load(text)
    # As the comment says: three lines into the DBC, and the # before publish removed.
    first = text.index("# BO_ 1665 RIG_ESTIMATE")
    statements = text[first:].splitlines()[:3]
    end = used.index("\n\n", used.index("BO_ 1664"))
    own = "\n\n" + "\n".join(line.removeprefix("# ") for line in statements)
    dbc.write_text(used[:end] + own + used[end:])
    for line in text[first:].splitlines()[3:6]:
        text = text[:first] + text[first:].replace(line, line.removeprefix("# "))
    (tmp_path / "my.yaml").write_text(text)
    plan = load_plan(tmp_path / "my.yaml")
    assert not errors(plan)
    assert plan.config.publish["strut"]["valid"].signal == "VALID"


def test_the_packages_own_dbc_gives_its_own_signals():
    database = load_database(DEFAULT_DATABASE)
    signals = find_signals(database)
    assert {choice.quantity.key: choice.name for choice in signals.choices} == {
        "height": "BENCH_MEASUREMENT.HEIGHT",
        "applied_force": "BENCH_MEASUREMENT.APPLIED_FORCE",
        "load_cell_force": "BENCH_AUXILIARY.LOAD_CELL_FORCE",
        "temperature": "BENCH_AUXILIARY.TEMPERATURE",
    }
    assert signals.unclear == ()
    proposed = yaml.safe_load(propose(DEFAULT_DATABASE))
    assert proposed["publish"] == {
        "force": {"message": "RIG_ESTIMATE", "signal": "SPRING_DAMPER_FORCE"},
        "valid": {"message": "RIG_ESTIMATE", "signal": "VALID"},
    }
    assert proposed["status"] == "RIG_STATUS"


def test_a_signal_that_says_valid_and_one_of_the_mode_are_proposed(dbc, tmp_path):
    dbc.write_text(
        DBC.replace(
            " SG_ Setpoint",
            ' SG_ ForceOk : 40|1@0+ (1,0) [0|1] "" SENSOR\n'
            ' SG_ BridgeState : 55|4@0+ (1,0) [0|15] "" SENSOR\n'
            ' SG_ MsgCnt : 59|4@0+ (1,0) [0|15] "" SENSOR\n SG_ Setpoint',
        )
    )
    text = propose(dbc)
    proposed = yaml.safe_load(text)
    assert proposed["publish"]["valid"] == {"message": "CONTROL_1", "signal": "ForceOk"}
    assert proposed["publish"]["counter"] == {"message": "CONTROL_1", "signal": "MsgCnt"}
    assert proposed["status"] == {"state": {"message": "CONTROL_1", "signal": "BridgeState"}}
    (tmp_path / "my.yaml").write_text(text)
    assert not errors(load_plan(tmp_path / "my.yaml"))


FLAGS = (
    ' SG_ {flag} : 32|1@0+ (1,0) [0|1] "" CONTROL\n SG_ Alive : 47|4@0+ (1,0) [0|15] "" CONTROL\n'
)


@pytest.mark.parametrize(
    ("flag", "values", "value"),
    [
        ("TravelOk", "", 1),
        ("TravelFault", "", 0),
        ("AliveOk", "", 1),
        ("TravelQual", 'VAL_ 288 TravelQual 0 "ok" 1 "broken" ;\n', 0),
    ],
)
def test_validity_and_counter_of_the_heights_message_are_used(flag, values, value, dbc, tmp_path):
    signals = FLAGS.format(flag=flag) + " SG_ OilTemp"
    dbc.write_text(DBC.replace(" SG_ OilTemp", signals) + values)
    text = propose(dbc)
    height = yaml.safe_load(text)["signals"]["height"]
    assert height["valid"] == {"signal": flag, "value": value}
    assert height["counter"] == "Alive"
    (tmp_path / "my.yaml").write_text(text + "unsafe: {publish_without_valid: true}\n")
    assert not errors(load_plan(tmp_path / "my.yaml"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("SuspFrnt_L_Actl", ["susp", "frnt", "l", "actl"]),
        ("RRShockPot", ["rr", "shock", "pot"]),
        ("load_cell_2", ["load", "cell"]),
        ("Öldruck", ["öldruck"]),
    ],
)
def test_words_of_a_name(name, words):
    assert list(split_name(name)) == words


def test_an_estimate_is_published_and_not_taken_as_a_load_cell(dbc):
    dbc.write_text(DBC.replace(" SG_ EstimatedForce : 7|16@0-", " SG_ EST_StrutForce : 7|16@0-"))
    assert find_force(load_database(dbc), Force.IN_STRUT, None) is None
    published = yaml.safe_load(propose(dbc))["publish"]
    assert published == {"force": {"message": "CONTROL_1", "signal": "EST_StrutForce"}}


def test_the_mode_is_not_published_in_a_message_of_another_node(dbc):
    other = 'BO_ 500 SERVICE: 8 PLC\n SG_ RigState : 0|4@1+ (1,0) [0|15] "" SENSOR\n\nBA_DEF_ BO_'
    text = DBC.replace("BU_: SENSOR CONTROL", "BU_: SENSOR CONTROL PLC")
    dbc.write_text(text.replace("BA_DEF_ BO_", other, 1))
    assert "status" not in yaml.safe_load(propose(dbc))


FOREIGN = """BO_ 705 AFS_Hoogte: 6 SENSOR
 SG_ AFS_HgtTel : 7|4@0+ (1,0) [0|15] "" CONTROL
 SG_ AFS_HgtGld : 2|1@0+ (1,0) [0|1] "" CONTROL
 SG_ AFS_LampAan : 1|1@0+ (1,0) [0|1] "" CONTROL
 SG_ AFS_Height : 15|20@0- (0.01,0) [-5242.88|5242.87] "mm" CONTROL

BO_ 1248 GST_Schatting: 4 CONTROL
 SG_ GST_PootKr : 0|16@1- (0.05,0) [-1638.4|1638.35] "daN" SENSOR

"""


def test_what_names_of_another_language_may_mean_is_left_to_the_user(dbc):
    """Bits and counters of the message are named with what to write, and forces of other nodes."""
    dbc.write_text(HEADER + FOREIGN + CYCLES + 'BA_ "GenMsgCycleTime" BO_ 705 4;\n')
    text = propose(dbc)
    assert "add: valid: {signal: AFS_HgtGld, value: 1}; or AFS_LampAan" in text
    assert "add: counter: AFS_HgtTel" in text
    hint = text.index("GST_Schatting (GST_PootKr). If so, remove the # before these lines:")
    lines = text[hint:].splitlines()[1:3]
    assert yaml.safe_load("\n".join(line.removeprefix("# ") for line in lines)) == {
        "publish": {"force": {"message": "GST_Schatting", "signal": "GST_PootKr"}}
    }
    assert yaml.safe_load(text)["signals"]["height"] == {
        "message": "AFS_Hoogte",
        "signal": "AFS_Height",
    }


FRENCH = """
BO_ 704 CAP_Hauteur: 6 SENSOR
 SG_ CAP_Height : 15|16@0- (0.05,0) [-1638|1638] "mm" CONTROL
 SG_ CAP_Classe : 39|4@0+ (1,0) [0|15] "" CONTROL
 SG_ CAP_HautNb : 35|4@0+ (1,0) [0|15] "" CONTROL
 SG_ CAP_HautVal : 0|1@0+ (1,0) [0|1] "" CONTROL

BO_ 1248 INV_Estimation: 4 CONTROL
 SG_ INV_EstVal : 0|1@1+ (1,0) [0|1] "" SENSOR
 SG_ INV_EstNb : 4|4@1+ (1,0) [0|15] "" SENSOR
 SG_ INV_EstForce : 8|16@1- (0.1,0) [-3276.8|3276.7] "daN" SENSOR

"""
FRENCH_COMMENTS = """
CM_ SG_ 704 CAP_Classe "Réglage interne du capteur";
CM_ SG_ 704 CAP_HautNb "Compteur de messages, 0 à 15";
CM_ SG_ 704 CAP_HautVal "1 : hauteur valide";
CM_ SG_ 1248 INV_EstNb "Compteur de messages";
VAL_ 1248 INV_EstVal 0 "invalide" 1 "valide" ;
"""


def test_comments_and_values_state_what_names_of_another_language_do_not(dbc):
    dbc.write_text(HEADER + FRENCH + CYCLES + FRENCH_COMMENTS, "utf-8")
    text = propose(dbc)
    proposed = yaml.safe_load(text)
    assert proposed["signals"]["height"]["valid"] == {"signal": "CAP_HautVal", "value": 1}
    assert "add: counter: CAP_HautNb; or CAP_Classe" in text
    assert proposed["publish"]["valid"] == {"message": "INV_Estimation", "signal": "INV_EstVal"}
    assert proposed["publish"]["counter"] == {"message": "INV_Estimation", "signal": "INV_EstNb"}


def test_bits_of_the_estimate_are_named_if_none_says_what_it_is(dbc):
    dbc.write_text(HEADER + FRENCH + CYCLES, "utf-8")
    assert "if this is its bit: valid: {message: INV_Estimation, signal: INV_EstVal}" in propose(
        dbc
    )
