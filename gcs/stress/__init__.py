"""Campaigns: trials over link parameters, growth rates, the onset of instability, maps and their report.

`study` says which trials are flown, `campaign` flies and stores them, `measure` judges each, `report` shows the result.
"""
