"""Parameters of a belief over places whose landmarks are seen worse than those of simulated lasers."""

from hmt_slam_ros.configuration.places import Places

ROUGH = Places(
    reach=6.0, aside=4.0, detection=0.8, position_deviation=0.1, heading_deviation=5.0, width_deviation=0.1,
    false_density=0.01, new_density=0.01, usual_density=0.08, true_share=0.9, max_entropy=0.1,
)  # fmt: skip
