"""The names of the topics; all but that of the time are relative, so that a namespace moves them together."""

from hmt_slam_ros.processes.messages import Accepted, AreaEvents, Arriving, Hypotheses, LocalEstimate, Notice

SCAN, ODOM, CLOCK = "scan", "odom", "/clock"
COMMANDS, GROUND_TRUTH = "cmd_vel", "ground_truth"
ERRANDS = {"explorer": "explorer/errand", "pilot": "pilot/errand"}
OUTCOMES = {"explorer": "explorer/outcome", "pilot": "pilot/outcome"}
GOALS, PLACE = "goal_pose", "pilot/place"
KEYFRAMES, KEYFRAME_SCANS = "hmt/keyframes", "hmt/keyframe_scans"
TRAIL = "hmt/trail"
FINISHED = "hmt/finished"
ROBOT_STATUS = "hmt/robot_status"
SAVE, SAVED = "hmt/save", "hmt/saved"
BEGIN, BEGUN = "hmt/begin", "hmt/begun"
COST = "hmt/cost"
HMT_POSE, POSE = "hmt/pose", "pose"
MAP, GRAPH, PARTICLES, PMF = "map", "hmt/graph", "hmt/particles", "hmt/pmf"
IS_LOCALIZED, ENTROPY = "hmt/is_localized", "hmt/entropy"
INITIAL_POSE = "initialpose"
DIAGNOSTICS = "diagnostics"

DOCUMENTS: dict[type, str] = {
    AreaEvents: "hmt/area_events",
    Hypotheses: "hmt/hypotheses",
    Accepted: "hmt/accepted",
    LocalEstimate: "hmt/local_pose",
    Arriving: "hmt/arriving",
    Notice: "hmt/notices",
}
