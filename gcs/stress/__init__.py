"""Campaigns: does the formation break where its delay margin says, over link parameters, seeds and rates?

`study` chooses the trials: over the `axes`, and in search of the onset. `campaign` flies and stores them, and can fly
one of them again. `measure` judges each `trial` by the `growth` of its `free_response`. `report` shows the result,
with `figures` and, for two axes, the `boundary` of a map. `gcs.cli.stress` is the command.
"""
