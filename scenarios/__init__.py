"""What an experiment is: the schema of a scenario file, and how it is read and written; signing of links."""
