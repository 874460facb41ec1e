"""Questions answered by designing and flying, one command each; `gcs.cli.studies` has their options.

`compare` sets the design routes side by side, with `compare_cost` as formations grow. `front` says what can be had at a
loop delay, and what prediction is worth. `thesis` reproduces the source, with the flights and figures of
`thesis_flights`. `capacity` finds how many vehicles a scenario's links carry, `benchmark` how fast flights are
computed, and `cluster` what a map costs on Dask. `peers` does the same work with other people's tools. `virtual` flies
a scenario for a user of Python.
"""
