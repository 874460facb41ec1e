"""What a run leaves behind: files, refusals, summaries, and what happens on a full disk."""
