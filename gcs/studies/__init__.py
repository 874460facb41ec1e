"""Questions answered by designing and flying, one command each; `gcs.cli.studies` has their options.

`compare` flies all design routes, and `compare_cost` times them as formations grow. `front` finds the best gains at a
loop delay, and the worth of prediction. `identification` finds how vehicles respond to set-points. `thesis` reproduces
the source, with the flights and figures of `thesis_flights`. `capacity` finds how many vehicles a scenario's links
carry, `benchmark` how fast flights are computed, and `cluster` the cost of a map on Dask. `peers` does the same work
with other people's tools. `virtual` flies a scenario from Python.
"""
