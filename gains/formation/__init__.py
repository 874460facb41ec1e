"""Formation models, information patterns, the inclusion principle, partitions and fixed modes. Begin at `model`."""
