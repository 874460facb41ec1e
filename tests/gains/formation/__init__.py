"""Formation models, information patterns and the structure of the gains on them."""
