"""Every command: options, one-line errors and what a terminal prints. The only package that imports Typer.

The exit codes are defined here; 0 is success. A group of commands has a file; what needs imports too slow for
`gcs --help` to print it is in `results`.
"""

FAILED = 1
"""The command did its work, and the answer is bad: unstable, past the margin, not the same."""
BAD_INPUT = 2
INTERRUPTED = 130
"""Ended by Ctrl-C, SIGTERM or SIGHUP."""
