"""What test modules share; nothing is tested here."""
