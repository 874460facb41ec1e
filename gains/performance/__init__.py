"""What given gains do: robustness, string stability, response of the vehicles, and these at a loop delay."""
