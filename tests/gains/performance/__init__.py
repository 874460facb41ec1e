"""What given gains do: alpha, growth, string stability, and the response of the vehicles."""
