"""The numbers in the frames that kernels read and make are those of the dialect."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services import frames
from sim_vehicles.services.frames import first_message
from sim_vehicles.services.mavlink import message_id


def test_message_ids_and_extras_are_those_of_the_dialect() -> None:
    for message, number in (
        (dialect.MAVLink_heartbeat_message, frames.HEARTBEAT),
        (dialect.MAVLink_param_value_message, frames.PARAMETER_VALUE),
        (dialect.MAVLink_local_position_ned_message, frames.LOCAL_POSITION),
        (dialect.MAVLink_global_position_int_message, frames.GLOBAL_POSITION),
        (dialect.MAVLink_set_position_target_local_ned_message, frames.SETPOINT),
        (dialect.MAVLink_timesync_message, frames.TIMESYNC),
    ):
        assert (message.id, message.crc_extra) == (number, frames.EXTRA[number])
    assert frames.AUTOPILOT == dialect.MAV_COMP_ID_AUTOPILOT1
    assert frames.STATION_TYPE == dialect.MAV_TYPE_GCS
    assert frames.LOCAL_NED == dialect.MAV_FRAME_LOCAL_NED
    assert frames.ARDUPILOT == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA


@given(st.binary(max_size=14), st.booleans())
def test_the_kernel_finds_the_message_id_that_the_codec_finds(data: bytes, framed: bool) -> None:
    data = b"\xfd" + data if framed else data
    array = np.zeros(20, np.uint8)
    array[: len(data)] = np.frombuffer(data, np.uint8)
    assert first_message(array, len(data)) == message_id(data)
