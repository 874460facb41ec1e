"""The ground station: flies formations over MAVLink and compares measured loop delay with the delay margin."""
