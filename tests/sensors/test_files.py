"""Sensors described by EDS files, and files that are wrong."""

import random

import pytest
from typer.testing import CliRunner

from can_dbc.database import load_database
from can_dbc.errors import InputError
from rig.cli.main import app
from rig.sensors.canopen_device import describe_device
from rig.sensors.eds_file import EdsObjects
from rig.sensors.undo_file import read_undo


def variable(section, kind, value="", access="ro"):
    return (
        f"[{section}]\nParameterName=Object {section}\nObjectType=0x7\nDataType=0x{kind:04X}\n"
        f"AccessType={access}\nDefaultValue={value}\nPDOMapping=0\n"
    )


def record(section, *members):
    head = f"[{section}]\nParameterName=Object {section}\nObjectType=0x9\n"
    head += f"SubNumber={len(members) + 1}\n"
    count = variable(f"{section}sub0", 5, len(members))
    return (
        head
        + count
        + "".join(
            variable(f"{section}sub{place}", kind, value)
            for place, (kind, value) in enumerate(members, 1)
        )
    )


EDS = "".join(
    (
        "[FileInfo]\nFileName=wire.eds\n[DeviceInfo]\nVendorName=Somebody\nProductName=Wire\n",
        "[MandatoryObjects]\nSupportedObjects=1\n1=0x1000\n",
        variable("1000", 7, "0x00080196"),
        variable("1014", 7, "$NODEID+0x80", "rw"),
        variable("1017", 6, "200", "rw"),
        record("1018", (7, "0x1A2"), (7, "7")),
        record("1800", (7, "$NODEID+0x180"), (5, "254"), (6, "0"), (5, "0"), (6, "4")),
        record("1801", (7, "$NODEID+0x80000280"), (5, "1")),
        record("1A00", (7, "0x60040020"), (7, "0x60300110")),
        variable("6004", 4),
        record("6005", (7, "100000"), (7, "10")),
        record("6030", (3, "")),
    )
)


@pytest.fixture
def eds(tmp_path):
    path = tmp_path / "wire.eds"
    path.write_text(EDS)
    return path


def test_a_sensor_that_is_not_there_is_described_by_its_file(eds):
    device = describe_device(EdsObjects(eds, 7), 7)
    assert (device.emergency_id, device.heartbeat_s) == (0x87, 0.2)
    (pdo,) = device.pdos
    assert (pdo.arbitration_id, pdo.cycle_s) == (0x187, 0.004)
    position, speed = pdo.mapped
    assert position.meaning.scale == pytest.approx(0.1)  # 100 µm a step, in mm
    assert (speed.meaning.unit, speed.meaning.scale) == ("mm/s", pytest.approx(0.1))


def test_dbc_from_a_file(eds, tmp_path):
    out = tmp_path / "found"
    result = CliRunner().invoke(app, ["sensor", "scan", "--eds", f"7={eds}", "--out", str(out)])
    assert result.exit_code == 0, result.output
    message = load_database(out / "sensors.dbc").message("NODE_7_TPDO1")
    assert message.signals["POSITION"].unit == "mm"
    assert message.cycle_time_ns == 4_000_000


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "no device type"),
        ("hello", "is no EDS file"),
        ("[1000]\nParameterName=x\n", "is no EDS file"),
        ("[1000]\nParameterName=x\nDataType=0x7\nAccessType=ro\n", "has no value"),
        ("\x00\x01\xff", "is no EDS file"),
    ],
)
def test_files_that_are_none(tmp_path, content, expected):
    path = tmp_path / "bad.eds"
    path.write_text(content, "latin-1")
    refused = CliRunner().invoke(app, ["sensor", "scan", "--eds", f"7={path}"]).exception
    assert isinstance(refused, InputError)
    assert expected in str(refused)
    assert str(path) in str(refused)
    assert "\n" not in str(refused)


def mutated(rng, text):
    data = bytearray(text.encode())
    for _ in range(rng.randint(1, 2)):
        kind, place = rng.randrange(4), rng.randrange(len(data))
        if kind == 0:
            data[place] = rng.randrange(256)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 60)]
        elif kind == 2:
            data[place:place] = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 9)))
        else:
            del data[place:]
        if not data:
            data = bytearray(b"[")
    return bytes(data)


def try_mutations(folder, count, seed):
    rng = random.Random(seed)
    path = folder / "mutated.eds"
    described_so_far = 0
    for _ in range(count):
        path.write_bytes(mutated(rng, EDS))
        refused = None
        try:
            device = describe_device(EdsObjects(path, 7), 7)
            described_so_far += device is not None
        except InputError as error:
            refused = str(error)
        assert refused is None or (str(path) in refused and "\n" not in refused)
    return described_so_far


def test_mutated_files(tmp_path):
    assert try_mutations(tmp_path, 300, seed=1) > 10


@pytest.mark.long
def test_ten_thousand_mutated_files(tmp_path):
    assert try_mutations(tmp_path, 10_000, seed=2) > 300


@pytest.mark.parametrize(
    "content",
    [
        "",
        "schema: 2\nchanges: []\n",
        "schema: 1\nchanges: [{node_id: 0, index: 6144, subindex: 5, before: '0a00'}]\n",
        "schema: 1\nchanges: [{node_id: 5, index: 6144, subindex: 5, before: xyz}]\n",
        "schema: 1\nchanges: [{node_id: 5, index: 6144, subindex: 5}]\n",
        "schema: 1\nchanges: [{node_id: 5, index: 4112, subindex: 1, before: '73617665'}]\n",
    ],
)
def test_undo_files_that_are_wrong(tmp_path, content):
    path = tmp_path / "before.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=r"before\.yaml"):
        read_undo(path)


@pytest.mark.parametrize(
    "arguments",
    [
        ["set"],
        ["set", "5", "--sync"],
        ["set", "5", "--restore", "x.yaml"],
        ["scan", "--eds", "wire.eds"],
        ["scan", "--eds", "300=wire.eds"],
        ["scan", "--interface", "nonsense"],
    ],
)
def test_calls_that_cannot_be(arguments):
    result = CliRunner().invoke(app, ["sensor", *arguments])
    assert isinstance(result.exception, InputError)
    assert "\n" not in str(result.exception)
