"""The keys of a scenario, a file for each part of it; `scenarios.schema` puts them together. Begin with `part`."""
