"""What a run leaves behind: its files, the tick record on disk, the summary with the verdict, the grade."""
