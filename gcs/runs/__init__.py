"""What a run leaves behind: its files, the tick record on disk, the summary with the verdict, the grade.

Begin at `record`, which writes during a flight; `summary` reads the logs after it, `files` reads each file back.
"""
