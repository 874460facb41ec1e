"""What people see of a flight: the live table, the Rerun recording, pages."""
