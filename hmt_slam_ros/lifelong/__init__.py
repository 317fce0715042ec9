"""Lifelong mapping: what changed in a known map."""
