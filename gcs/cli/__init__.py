"""Every command: its options, one-line errors and printed output. The only room that imports Typer.

The exit codes are defined here; 0 is success. Each group of commands has a file. Output whose imports would slow down
`gcs --help` is in `results`.
"""

FAILED = 1
"""The command did its work, but the answer is bad: unstable, past the margin, not identical."""
BAD_INPUT = 2
INTERRUPTED = 130
"""Ended by Ctrl-C, SIGTERM or SIGHUP."""
