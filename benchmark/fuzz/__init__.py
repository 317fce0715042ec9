"""Mutated files against every reader, each in a process of its own with limits of time and memory."""
