"""Services that every MAVLink system needs: codec, clock, parameters, message schedule, command authority."""
