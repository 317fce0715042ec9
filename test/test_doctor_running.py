"""What the doctor finds in a running system, from what it observed."""

from collections import defaultdict
from dataclasses import replace

from hmt_slam_ros.doctor.running import NodeStatus, RunningSystem, Topic, running_findings
from hmt_slam_ros.process_table import process_names


def test_nodes_that_compile_their_kernels_are_no_fault_of_a_running_system():
    text = "compiling kernels, 40 s left"
    statuses = tuple(NodeStatus(f"/{name}", 0, text, "inactive") for name in process_names())
    topics = defaultdict(lambda: Topic(1, ("driver",)))
    running = RunningSystem(1.0, topics, process_names(), (), statuses, {}, {})
    findings = list(running_findings(running))
    assert {finding.severity for finding in findings} <= {"fine"}
    assert any(f"/slam: {text}; " in finding.text for finding in findings)
    waiting = replace(running, topics=defaultdict(lambda: Topic(0, ("robot",))))
    findings = list(running_findings(waiting))
    assert {finding.severity for finding in findings} == {"fine"}
    assert "robot sends nothing on scan until the kernels are compiled." in [finding.text for finding in findings]
    driven = replace(running, topics=defaultdict(lambda: Topic(0, ("driver",))))
    assert "wrong" in {finding.severity for finding in running_findings(driven)}


def test_nodes_without_a_system_that_run_twice_are_named():
    topics = defaultdict(lambda: Topic(1, ("driver",)))
    running = RunningSystem(1.0, topics, (*process_names(), "rtl"), (), (), {}, {})
    findings = [finding for finding in running_findings(running) if finding.severity == "wrong"]
    assert [(finding.subject, finding.text) for finding in findings] == [
        (
            "two systems",
            "rtl runs twice in this namespace (a killed node counts for 20 s): end all but one, or give each system a "
            "namespace or a ROS_DOMAIN_ID of its own.",
        )
    ]
