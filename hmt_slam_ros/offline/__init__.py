"""The lock-step runtime: all processes in one program."""
