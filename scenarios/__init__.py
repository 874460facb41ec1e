"""What an experiment is: the schema of a scenario file, and reading and writing one."""
