"""Topological Loop Closure Acceptance, process 4 of the paper: which topology is definite."""
