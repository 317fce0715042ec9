"""Mutation testing: do the unit tests notice small faults in the numerical core?"""
