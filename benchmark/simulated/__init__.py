"""Runs on simulated worlds, compared with the truth from outside."""
