"""Topological Space Bayesian Inference, process 3 of the paper: the probability of every topology."""
