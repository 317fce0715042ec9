"""Checks on a log or a running system, for ``hmt_slam doctor``.

`statistics` and `frames` gather arrays in one pass; each check is a function from these to findings.
"""
