"""The conversation with one vehicle: MAVLink codec, sequence numbers, clocks, start-up of autopilots."""
