"""What the records of a saved map have to be before any process sees them.

Checksums tell damage, not intent. Every record that is read is checked here by the name of its class: its fields by
themselves, and that what they refer to exists. :func:`check_run_state` does so across processes. Classes are named and
not imported, so that a node loads no code of other processes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Set
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.saved_map.field_limits import MAX_AREAS, MAX_COUNT, SYMMETRY, check_fields, require
from hmt_slam_ros.untrusted_input import shorten

if TYPE_CHECKING:
    from hmt_slam_ros.configuration import Configuration

_PATCH = 32
"""Cells along one edge of a patch of a grid."""


def check_record(record: Any, path: str) -> None:  # noqa: ANN401  any record of a document
    """Check a record whose fields have their types and whose own records are checked.

    :param path: of the record in its document.
    :raises HmtSlamError: names the field, its value and what it has to be.
    """
    check_fields(record, path)
    check = _CHECKS.get(type(record).__name__)
    if check is not None:
        check(record, path)


def _check_graph(graph: Any, path: str) -> None:  # noqa: ANN401
    require(int(graph.keyframe_counts.sum()) == graph.keyframes.size, f"{path}.keyframe_counts", "", "those of poses")
    for name in ("areas", "keyframes"):
        require(bool((getattr(graph, name) >= 0).all()), f"{path}.{name}", "negative", "0 or more")
    require(bool((graph.areas < MAX_AREAS).all()), f"{path}.areas", graph.areas.max(initial=0), f"below {MAX_AREAS}")
    require(np.unique(graph.areas).size == graph.areas.size, f"{path}.areas", "an area twice", "one of each")
    require(
        bool((graph.arcs[:, 0] < graph.arcs[:, 1]).all()), f"{path}.arcs", "an arc", "from a smaller to a larger area"
    )
    require(len(np.unique(graph.arcs, axis=0)) == len(graph.arcs), f"{path}.arcs", "an arc twice", "one of each")
    kept = graph.covariances[~graph.removed]
    _check_invertible(kept, f"{path}.covariances")


def _check_invertible(covariances: NDArray[np.float64], path: str) -> None:
    if covariances.size:
        least = np.linalg.eigvalsh(covariances)[..., 0].min()
        require(bool(least > 0.0), path, f"a matrix with an eigenvalue {least:g}", "positive definite")


def _check_replica(replica: Any, path: str) -> None:  # noqa: ANN401
    """Check that all hypotheses have a map, a probability and an area, and all keyframes a scan."""
    hypotheses = replica.changes.keys()
    require(bool(hypotheses), f"{path}.changes", "empty", "of one hypothesis or more")
    require(all(0 <= h < MAX_COUNT for h in hypotheses), f"{path}.changes", list(hypotheses), "of numbers from 0 on")
    for name in ("probabilities", "robot_areas"):
        require(getattr(replica, name).keys() == hypotheses, f"{path}.{name}", "", "of the hypotheses of changes")
    total = sum(replica.probabilities.values())
    require(0.0 < total <= 1.0 + SYMMETRY, f"{path}.probabilities", f"a sum of {total:g}", "above 0, at most 1")
    common = replica.common
    require(not common.removed.any(), f"{path}.common.removed", True, "false, as none can be removed there")
    areas = set(common.areas.tolist())
    require(max(areas, default=-1) <= replica.max_area_id, f"{path}.max_area_id", replica.max_area_id, "the largest")
    _check_ends(common, areas, f"{path}.common")
    for hypothesis, change in replica.changes.items():
        known = areas | set(change.areas.tolist())
        _check_ends(change, known, f"{path}.changes")
        area = replica.robot_areas[hypothesis]
        require(not known or area in known, f"{path}.robot_areas", area, "an area of the hypothesis")
    for graph in (common, *replica.changes.values()):
        missing = set(graph.keyframes.tolist()) - replica.scans.keys()
        require(not missing, f"{path}.scans", f"without {shorten(sorted(missing))}", "a scan for every keyframe")


def _check_ends(graph: Any, areas: Set[int], path: str) -> None:  # noqa: ANN401
    strange = set(graph.arcs.ravel().tolist()) - areas
    require(not strange, f"{path}.arcs", shorten(sorted(strange)), "between areas of the map")


def _check_area_poses(name: str) -> Callable[[Any, str], None]:
    """Check that ``map_T_area`` are ordered by area, each once."""

    def check(record: Any, path: str) -> None:  # noqa: ANN401
        areas = [entry.area for entry in getattr(record, name)]
        require(areas == sorted(set(areas)), f"{path}.{name}", areas, "ordered by area")

    return check


def _check_scan_poses(table: Any, path: str) -> None:  # noqa: ANN401
    require(int(table.sizes.sum()) == table.stamps.size, f"{path}.sizes", table.sizes, "those of the poses")


def _check_scans(table: Any, path: str) -> None:  # noqa: ANN401
    require(int(table.beams.sum()) == table.ranges.size, f"{path}.beams", table.beams, "those of the ranges")
    require(np.unique(table.names).size == table.names.size, f"{path}.names", "one twice", "one of each")
    rows = table.partial_beams
    require(bool(((rows >= 0) & (rows < table.ranges.size)).all()), f"{path}.partial_beams", rows, "beams")


def _check_particles(state: Any, path: str) -> None:  # noqa: ANN401
    require(state.log_weights.size > 0, f"{path}.log_weights", "empty", "of one particle or more")
    require(state.leader < state.log_weights.size, f"{path}.leader", state.leader, "one of the particles")
    require(bool((state.log_weights <= SYMMETRY).all()), f"{path}.log_weights", state.log_weights.max(), "0 or less")
    require(bool((state.tables >= -1).all()), f"{path}.tables", state.tables.min(initial=0), "-1 or more")
    _check_local_keyframes(state, state.keyframe_poses.shape[1], path)


def _check_local_keyframes(state: Any, count: int, path: str) -> None:  # noqa: ANN401
    for name in ("keyframes", "keyframe_areas"):
        require(len(getattr(state, name)) == count, f"{path}.{name}", getattr(state, name), f"{count} numbers")


def _check_lines(state: Any, path: str) -> None:  # noqa: ANN401
    _check_local_keyframes(state, len(state.reported_poses), path)
    clones = len(state.line_map.clones.poses)
    require(clones == 1 + len(state.keyframes), f"{path}.line_map.clones", clones, "of the last pose and all keyframes")


def _check_line_map(state: Any, path: str) -> None:  # noqa: ANN401
    size = 3 + 2 * len(state.walls)
    require(state.mean.size == size, f"{path}.mean", state.mean.size, f"{size} numbers for its walls")
    columns = state.clones.cross_covariances.shape[2]
    require(columns == size, f"{path}.clones.cross_covariances", columns, f"of {size} columns")


def _check_live_hypothesis(state: Any, path: str) -> None:  # noqa: ANN401
    filters = [state.particle_filter, state.line_filter]
    require(filters.count(None) == 1, f"{path}.particle_filter", "with line_filter", "either of the two")


def _check_slam(state: Any, path: str) -> None:  # noqa: ANN401
    live, replica = state.live_hypotheses, state.replica
    require(
        not live or live.keys() >= replica.changes.keys(), f"{path}.live_hypotheses", list(live), "those of replica"
    )
    _check_events(replica, state.keyframe_events, f"{path}.keyframe_events")
    patches = 0 if state.patches is None else len(state.patches.odds)
    for hypothesis in replica.changes.keys() & live.keys():
        own = live[hypothesis]
        filter_state = own.particle_filter or own.line_filter
        place = f"{path}.live_hypotheses[{hypothesis}]"
        require(filter_state.hypothesis == hypothesis, place, filter_state.hypothesis, "of its own number")
        _check_references(replica, hypothesis, filter_state, place)
        if own.particle_filter is not None:
            most = int(own.particle_filter.tables.max(initial=-1))
            require(most < patches, f"{place}.particle_filter.tables", most, f"below {patches}, the number of patches")


def _check_references(replica: Any, hypothesis: int, own: Any, path: str) -> None:  # noqa: ANN401
    """Check that the areas and keyframes of a filter are in the map."""
    graphs = (replica.common, replica.changes[hypothesis])
    areas = {area for graph in graphs for area in graph.areas.tolist()}
    require(not areas or own.area in areas, f"{path}.area", own.area, "an area of the hypothesis")
    missing = set(own.keyframe_areas) - areas
    require(not missing, f"{path}.keyframe_areas", sorted(missing), "areas of the hypothesis")
    missing = set(own.keyframes) - replica.scans.keys()
    require(not missing, f"{path}.keyframes", sorted(missing), "keyframes of the map")


def _check_events(replica: Any, events: int, path: str) -> None:  # noqa: ANN401
    newest = max(replica.scans, default=-1)
    require(newest < events, path, events, f"above {newest}, the newest keyframe")


def _check_aam(state: Any, path: str) -> None:  # noqa: ANN401
    hypotheses = state.replica.changes.keys()
    require(state.partitions.keys() >= hypotheses, f"{path}.partitions", list(state.partitions), "those of replica")
    for partition in state.partitions.values():
        own = set(partition.graphs.values())
        numbers = own | {joined.graph for joined in partition.joined_graphs.values()}
        require(numbers <= state.graphs.keys(), f"{path}.partitions.graphs", sorted(numbers), "graphs of the state")
        # Graphs of two areas keep keyframes that were pruned since.
        missing = {keyframe for n in own for keyframe in state.graphs[n].keyframes} - state.replica.scans.keys()
        require(not missing, f"{path}.graphs.keyframes", sorted(missing), "keyframes of the map")


def _check_overlap_graph(graph: Any, path: str) -> None:  # noqa: ANN401
    count = len(graph.keyframes)
    require(graph.similarity.shape == (count, count), f"{path}.similarity", graph.similarity.shape, f"{count} square")
    same = bool(np.allclose(graph.similarity, graph.similarity.T))
    require(same, f"{path}.similarity", "a matrix", "symmetric")


def _check_tsbi(state: Any, path: str) -> None:  # noqa: ANN401
    _check_area_poses("global_poses")(state, path)
    hypotheses, own = state.replica.changes.keys(), state.hypothesis_states
    require(own.keys() >= hypotheses, f"{path}.hypothesis_states", list(own), "those of replica")
    most = max(hypotheses)
    require(state.next_hypothesis > most, f"{path}.next_hypothesis", state.next_hypothesis, f"above {most}")


def _check_tlca(state: Any, path: str) -> None:  # noqa: ANN401
    hypotheses = state.replica.changes.keys()
    for name in ("paths", "poses"):
        own = getattr(state, name)
        require(own.keys() >= hypotheses, f"{path}.{name}", list(own), "those of replica")


def _check_record_of_run(record: Any, path: str) -> None:  # noqa: ANN401
    _check_area_poses("global_poses")(record, path)
    _check_events(record.replica, record.events, f"{path}.events")
    require(
        all(parent < child for child, parent in record.parents.items()),
        f"{path}.parents",
        list(record.parents.items()),
        "older than their children",
    )
    count = record.estimates.scans.size
    require(len(record.online_trajectory) == count, f"{path}.online_trajectory", "", f"{count} poses, as the estimates")


def _check_log(log: Any, path: str) -> None:  # noqa: ANN401
    first, count = log.first_scans, log.stamps.size
    ordered = bool(first) and first[0] == 0 and list(first) == sorted(first) and first[-1] <= count
    require(ordered, f"{path}.first_scans", first, f"from 0 to {count}, ascending")
    require(bool((np.diff(log.stamps) > 0).all()), f"{path}.stamps", log.stamps, "increasing")
    read = log.records_read
    require(read >= count - first[-1], f"{path}.records_read", read, "as many as the scans of the newest log")


def _check_joined_motion(motion: Any, path: str) -> None:  # noqa: ANN401
    require(motion.weights.min() > 0.0, f"{path}.weights", motion.weights, "positive")


_CHECKS: Mapping[str, Callable[[Any, str], None]] = {
    "AamState": _check_aam,
    "GraphState": _check_graph,
    "LineFilterState": _check_lines,
    "LineMapState": _check_line_map,
    "LiveHypothesisState": _check_live_hypothesis,
    "LogProgress": _check_log,
    "MapDocument": _check_area_poses("area_poses"),
    "OdometryNoiseState": _check_joined_motion,
    "OverlapGraph": _check_overlap_graph,
    "ParticleFilterState": _check_particles,
    "ReplicaState": _check_replica,
    "RtlState": _check_area_poses("area_poses"),
    "RunRecord": _check_record_of_run,
    "ScanPoseTable": _check_scan_poses,
    "ScanTable": _check_scans,
    "SlamState": _check_slam,
    "TlcaState": _check_tlca,
    "TsbiState": _check_tsbi,
}
"""{class: check of what its fields are to each other}."""


def check_run_state(parts: Mapping[str, Any], configuration: Configuration) -> None:
    """Check that the states of all processes are of one moment of one run.

    :param parts: {part of the state: value}, each of which is checked.
    :param configuration: of the run that saved them.
    :raises HmtSlamError: names the part that differs from the others.
    """
    events = parts["slam"].keyframe_events
    require(parts["recorder"].events == events, "recorder.events", parts["recorder"].events, f"{events}, as of slam")
    reference = parts["slam"].replica
    for name in ("aam", "tsbi", "tlca", "recorder"):
        _check_same_map(parts[name].replica, reference, f"{name}.replica")
    check_slam_state(parts["slam"], configuration)


def _check_same_map(replica: Any, reference: Any, path: str) -> None:  # noqa: ANN401
    for name in ("scans", "changes", "robot_areas"):
        same = getattr(replica, name).keys() == getattr(reference, name).keys()
        require(same, f"{path}.{name}", list(getattr(replica, name)), "that of slam")
    require(dict(replica.robot_areas) == dict(reference.robot_areas), f"{path}.robot_areas", "", "that of slam")
    for graph, other in (
        (replica.common, reference.common),
        *((replica.changes[h], reference.changes[h]) for h in reference.changes),
    ):
        for name in ("areas", "keyframe_counts", "keyframes", "arcs"):
            same = np.array_equal(np.sort(getattr(graph, name), axis=0), np.sort(getattr(other, name), axis=0))
            require(same, f"{path}.{name}", getattr(graph, name), "that of slam")


def check_slam_state(state: Any, configuration: Configuration) -> None:  # noqa: ANN401
    """Check that the grids of metric SLAM have the size that the parameters say.

    :raises HmtSlamError: where they have another.
    """

    local_map, particles = configuration.local_map, configuration.filter.particles
    table = 2 * math.ceil(local_map.extent / (_PATCH * local_map.cell))
    for hypothesis, own in state.live_hypotheses.items():
        grids = own.particle_filter
        if grids is not None:
            path = f"slam.live_hypotheses[{hypothesis}].particle_filter.tables"
            wanted = (particles, table, table)
            require(grids.tables.shape == wanted, path, f"of shape {grids.tables.shape}", f"of shape {wanted}")
