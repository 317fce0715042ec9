"""Runs on simulated worlds that are watched from outside, and what they were judged by: the truth."""
