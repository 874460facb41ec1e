"""Every command: options, one-line errors, exit codes and what a terminal prints. The only room that knows Typer."""
