"""One emulated link: due times, order, draws, and the truth log."""
