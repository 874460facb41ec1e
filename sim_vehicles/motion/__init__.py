"""How simulated vehicles move: accelerations in, positions and velocities out; no MAVLink. See `double_integrator`."""
