"""Campaigns: does the formation break where its delay margin says, over link parameters, seeds and rates?

`study` says which trials are flown, over the `axes` and in search of the onset. `campaign` flies and stores them, or
one of them again. `measure` judges each `trial`, from a `free_response` and its `growth`. `report` shows the result,
with `figures` and, for two axes, the `boundary` of a map. `gcs.cli.stress` is the command.
"""
