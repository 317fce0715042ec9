"""Faults at every write: each call that changes a file fails, writes half, or is the last of its process."""
