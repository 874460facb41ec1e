"""What a design can be asked for besides margin, robustness and decay."""
