"""Registration: poses of scans in maps, of maps in maps, and of scans in each other.

Three matchers answer three questions. They differ in the width of the prior, and in the accuracy of the answer.

- :mod:`~hmt_slam_ros.registration.scan_to_map`: where is this scan in the submap? Gauss-Newton on a distance field,
  from a narrow prior by odometry; a correlative search where it is wide. All modes, mostly one, with covariances and
  masses.
- :mod:`~hmt_slam_ros.registration.area_to_area`: where may one area lie in another? Branch and bound over all relative
  poses of a wide prior by arcs. All modes, with their masses.
- :mod:`~hmt_slam_ros.registration.scan_to_scan`: how do keyframes lie to each other exactly? Point to line, from the
  poses found so far. All pairs jointly.

Beside them, ``dynamic_rejection`` removes moving objects from a match, ``match_covariance`` estimates its error, and
``consistency`` tests whether scans and maps contradict each other. docs/concepts/registration.md has the equations.
"""
