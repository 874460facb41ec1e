"""MAVLink 2 signing. `link` signs and verifies, `keys` reads key files, `stamps` remembers timestamps."""
