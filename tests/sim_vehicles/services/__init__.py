"""What a vehicle answers: parameters, authority, other stations' questions, and its boot clock."""
