"""The numbers in the frames that kernels read and make are those of the dialect."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services import frames


def test_message_ids_and_extras_are_those_of_the_dialect() -> None:
    for message, number in (
        (dialect.MAVLink_heartbeat_message, frames.HEARTBEAT),
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
