"""What is said before a flight: faults, manoeuvres, and delays over channels."""
