"""What is wrong with a log or with a running system, in sentences: ``hmt_slam doctor``.

Statistics are gathered in one pass, as arrays (`gathering`, `scan_motion`); odometry is compared with the scans
(`comparison`); each kind of check is a function from these to findings.
"""
