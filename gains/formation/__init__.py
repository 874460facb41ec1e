"""Formation models and information patterns, the inclusion principle, partitions and fixed modes."""
