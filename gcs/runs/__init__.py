"""The files of a run: the logs with the tick record, the summary with the verdict, the grade.

Begin at `record`, which writes during a flight; `summary` evaluates the logs after it; `files` reads each file back.
"""
