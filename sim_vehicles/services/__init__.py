"""What every MAVLink system needs: codec, clock, parameters, message schedule, whose commands it obeys."""
