"""What every MAVLink system needs: codec, clock, parameters, message schedule, who may command."""
