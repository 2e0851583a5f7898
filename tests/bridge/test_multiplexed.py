"""A bench's frames whose signals take turns."""

from can_dbc.database import load_database
from can_dbc.frame import Frame
from can_dbc.protection import FrameStatus, SequenceState
from rig.bridge.incoming_messages import Delivery, compile_incoming
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import HEIGHT

DBC = """VERSION ""
NS_ :
BS_:
BU_: BENCH RIG
BO_ 256 M: 8 BENCH
 SG_ PAGE M : 0|8@1+ (1,0) [0|0] "" RIG
 SG_ LEVEL m1 : 8|16@1+ (0.001,0) [0|0] "m" RIG
 SG_ OTHER m2 : 8|16@1+ (1,0) [0|0] "" RIG
"""


def verdicts(tmp_path, *payloads):
    path = tmp_path / "paged.dbc"
    path.write_text(DBC)
    message = load_database(path).message("M")
    level = Channel(0, Role.HEIGHT, HEIGHT, "strut", "", 0, 1, message=message, signal="LEVEL")
    made = compile_incoming(message, [level])
    assert made.deliveries == (Delivery(0, 0, 0),)
    return [made.read(SequenceState(), Frame(0, 256, data))[1:] for data in payloads]


def test_a_frame_of_another_page_is_no_fault_and_a_short_one_is(tmp_path):
    with_height = bytes([1]) + (421).to_bytes(2, "little") + bytes(5)
    without = bytes([2, 7, 0]) + bytes(5)
    found = verdicts(tmp_path, with_height, without, with_height[:2])
    assert found == [
        (FrameStatus.OK, (0.421,)),
        (FrameStatus.OK, None),
        (FrameStatus.WRONG_LENGTH, None),
    ]
