"""All processes in lock-step in one process, and the output folder."""
