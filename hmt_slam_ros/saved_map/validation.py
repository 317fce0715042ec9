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
from hmt_slam_ros.saved_map.hypothesis_maps import (
    HypothesisMap,
    check_hypothesis_maps,
    hypothesis_map,
    require_areas,
    require_keyframes,
)
from hmt_slam_ros.untrusted_input import shorten

if TYPE_CHECKING:
    from hmt_slam_ros.configuration import Configuration

_SUM_ERROR = 1e-6
"""Largest difference of a sum of probabilities to 1."""

_NO_KEYFRAME = -1

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
    require(bool((graph.areas >= 0).all()), f"{path}.areas", "negative", "0 or more")
    require(bool((graph.keyframes != _NO_KEYFRAME).all()), f"{path}.keyframes", _NO_KEYFRAME, "keyframes")
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
    for hypothesis in hypotheses:
        # Areas of the common map that all hypotheses replace may have keyframes that were pruned since.
        missing = set(hypothesis_map(replica, hypothesis).keyframes.tolist()) - replica.scans.keys()
        require(not missing, f"{path}.scans", f"without {shorten(sorted(missing))}", "a scan for every keyframe")
    check_hypothesis_maps(replica, path)


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
    modes = np.unique(state.members)
    every = np.arange(len(state.modes))
    require(np.array_equal(modes, every), f"{path}.members", modes, f"of each of the {every.size} modes")
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
        not live or live.keys() == replica.changes.keys(), f"{path}.live_hypotheses", list(live), "those of replica"
    )
    _check_events(replica, state.keyframe_events, f"{path}.keyframe_events")
    patches = 0 if state.patches is None else len(state.patches.odds)
    for hypothesis, own in live.items():
        filter_state = own.particle_filter or own.line_filter
        place = f"{path}.live_hypotheses[{hypothesis}]"
        require(filter_state.hypothesis == hypothesis, place, filter_state.hypothesis, "of its own number")
        _check_live_references(hypothesis_map(replica, hypothesis), own, filter_state, place)
        if own.particle_filter is not None:
            most = int(own.particle_filter.tables.max(initial=-1))
            require(most < patches, f"{place}.particle_filter.tables", most, f"below {patches}, the number of patches")


def _check_live_references(own: HypothesisMap, live: Any, filter_state: Any, path: str) -> None:  # noqa: ANN401
    """Check that the areas and keyframes of a live hypothesis are in its map."""
    if own.areas:  # at first there are none
        require_areas(own, [filter_state.area], f"{path}.area")
    require_areas(own, filter_state.keyframe_areas, f"{path}.keyframe_areas")
    require_keyframes(own, filter_state.keyframes, f"{path}.keyframes")
    require_keyframes(own, [anchor for _, anchor, _ in live.scan_poses], f"{path}.scan_poses")
    is_local = not own.areas or live.event.anchor in filter_state.keyframes
    require(is_local, f"{path}.event.anchor", live.event.anchor, "a keyframe of the local map")


def _check_events(replica: Any, events: int, path: str) -> None:  # noqa: ANN401
    newest = max(replica.scans, default=-1)
    require(newest < events, path, events, f"above {newest}, the newest keyframe")


def _check_aam(state: Any, path: str) -> None:  # noqa: ANN401
    hypotheses = state.replica.changes.keys()
    require(state.partitions.keys() == hypotheses, f"{path}.partitions", list(state.partitions), "those of replica")
    for hypothesis, partition in state.partitions.items():
        area = state.replica.robot_areas[hypothesis]
        require(partition.area == area, f"{path}.partitions.area", partition.area, f"{area}, the robot's area")
        own = set(partition.graphs.values())
        numbers = own | {joined.graph for joined in partition.joined_graphs.values()}
        require(numbers <= state.graphs.keys(), f"{path}.partitions.graphs", sorted(numbers), "graphs of the state")
        # Graphs of two areas keep keyframes that were pruned since.
        missing = {keyframe for n in own for keyframe in state.graphs[n].keyframes} - state.replica.scans.keys()
        require(not missing, f"{path}.graphs.keyframes", sorted(missing), "keyframes of the map")
        for joined in partition.joined_graphs.values():
            missing = joined.second_keyframes - set(state.graphs[joined.graph].keyframes)
            place = f"{path}.partitions.joined_graphs.second_keyframes"
            require(not missing, place, sorted(missing), "keyframes of the graph")


def _check_overlap_graph(graph: Any, path: str) -> None:  # noqa: ANN401
    count = len(graph.keyframes)
    require(graph.similarity.shape == (count, count), f"{path}.similarity", graph.similarity.shape, f"{count} square")
    same = bool(np.allclose(graph.similarity, graph.similarity.T))
    require(same, f"{path}.similarity", "a matrix", "symmetric")


def _check_tsbi(state: Any, path: str) -> None:  # noqa: ANN401
    _check_area_poses("global_poses")(state, path)
    hypotheses, own = state.replica.changes.keys(), state.hypothesis_states
    require(own.keys() == hypotheses, f"{path}.hypothesis_states", list(own), "those of replica")
    total = state.unexamined + sum(state.replica.probabilities.values())
    is_sum = abs(total - 1.0) <= _SUM_ERROR and state.unexamined < 1.0
    require(is_sum, f"{path}.unexamined", state.unexamined, "what the probabilities of the hypotheses leave of 1")
    for hypothesis, one in own.items():
        _check_hypothesis_state(one, state, hypothesis_map(state.replica, hypothesis), f"{path}.hypothesis_states")
    _check_marks(state, f"{path}.branching.marks")
    most = max(hypotheses)
    require(state.next_hypothesis > most, f"{path}.next_hypothesis", state.next_hypothesis, f"above {most}")


def _check_marks(state: Any, path: str) -> None:  # noqa: ANN401
    """Check that visits of marks are at keyframes with scans, in order."""
    for name, visits in state.branching.marks.visits.items():
        require(bool(visits), f"{path}.visits", shorten(name), "a mark that was visited")
        missing = {visit.keyframe for visit in visits} - state.replica.scans.keys()
        require(not missing, f"{path}.visits", shorten(sorted(missing)), "at keyframes with scans")
        events = [event for visit in visits for event in (visit.first_event, visit.last_event)]
        require(events == sorted(events), f"{path}.visits", shorten(events), "in the order of events")
    for visit in (visit for visits in state.branching.marks.visits.values() for visit in visits):
        _check_invertible(visit.pose.covariance, f"{path}.visits.pose.covariance")


def _check_hypothesis_state(one: Any, state: Any, own: HypothesisMap, path: str) -> None:  # noqa: ANN401
    """Check that areas and keyframes of what TSBI remembers of a hypothesis are in its map."""
    require_areas(own, one.local_area_poses, f"{path}.local_area_poses")
    require_areas(own, one.pending_candidates, f"{path}.pending_candidates")
    require_keyframes(own, one.covariances, f"{path}.covariances")
    missing = set(one.unmatched_keyframes) - one.covariances.keys()
    require(not missing, f"{path}.unmatched_keyframes", sorted(missing), "keyframes of covariances")
    if one.comparison is not None:
        _check_comparison(one.comparison, f"{path}.comparison")
    for event, pose in one.unstored_poses.items():
        is_stored = pose.keyframe == event and event in state.branching.unstored_scans
        require(is_stored, f"{path}.unstored_poses", event, "an event of unstored_scans")
    if one.is_lost:
        lost = one.localization
        known = (lost.candidate, lost.tracked_pose, lost.pose_hint, lost.false_alarm and lost.false_alarm.tracked_pose)
        require_areas(own, [pose.area for pose in known if pose is not None], f"{path}.localization")
        before = [keyframe for keyframe in one.unmatched_keyframes if keyframe < lost.since]
        require(not before, f"{path}.localization.since", lost.since, "that of the keyframes without a match")
        if lost.search is not None:
            require(bool(lost.search.poses), f"{path}.localization.search.poses", "empty", "one keyframe at least")
    elif one.localization.relocalized_area is not None:
        require_areas(own, [one.localization.relocalized_area], f"{path}.localization.relocalized_area")


def _check_comparison(comparison: Any, path: str) -> None:  # noqa: ANN401
    """Check that a comparison that goes on can be continued; areas that the map lacks are dropped then."""
    require(bool(comparison.query.poses), f"{path}.query.poses", "empty", "one keyframe at least")
    for known, candidate in comparison.candidates.items():
        keyframes = candidate.unmatched_poses.keys()
        is_part = bool(keyframes) and keyframes <= comparison.query.poses.keys()
        require(is_part, f"{path}.candidates[{known}].unmatched_poses", list(keyframes), "keyframes of query")
    for one in comparison.examined:
        is_whole = len(one.agreements) == len(one.modes) and 0.0 <= one.entry.probability <= 1.0
        require(is_whole, f"{path}.examined", one.area, "an area with a probability, and an agreement for each mode")


def _check_tlca(state: Any, path: str) -> None:  # noqa: ANN401
    hypotheses = state.replica.changes.keys()
    require(state.paths.keys() == hypotheses, f"{path}.paths", list(state.paths), "those of replica")
    require(state.poses.keys() >= hypotheses, f"{path}.poses", list(state.poses), "those of replica")
    for hypothesis, one in state.paths.items():
        own, place = hypothesis_map(state.replica, hypothesis), f"{path}.paths[{hypothesis}]"
        require(one.version <= state.change_count, f"{place}.version", one.version, f"at most {state.change_count}")
        pairs = {tuple(sorted((arc.source, arc.target))) for arc in one.pending_arcs}
        missing = sorted(pairs - own.arcs)
        require(not missing, f"{place}.pending_arcs", shorten(missing), "arcs of the hypothesis")
        ends = [area for closure in one.closures for area in (closure.near, closure.far)]
        require_areas(own, ends, f"{place}.closures")


def _check_record_of_run(record: Any, path: str) -> None:  # noqa: ANN401
    _check_area_poses("global_poses")(record, path)
    _check_events(record.replica, record.events, f"{path}.events")
    require(
        all(parent < child for child, parent in record.parents.items()),
        f"{path}.parents",
        list(record.parents.items()),
        "older than their children",
    )
    for hypothesis in record.replica.changes:
        own = hypothesis_map(record.replica, hypothesis)
        scans = record.scan_poses.select_hypotheses(record.lineage(hypothesis))
        require_keyframes(own, set(scans.keyframes.tolist()) - {-1}, f"{path}.scan_poses.keyframes")
    last = record.probabilities.keyframe[-1:].tolist()
    require(last == [record.events - 1][: record.events], f"{path}.probabilities", last, "up to the last event")
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


def _check_event_counts(counts: Any, path: str) -> None:  # noqa: ANN401
    require(counts.kidnappings <= counts.events, f"{path}.kidnappings", counts.kidnappings, "at most the events")


_CHECKS: Mapping[str, Callable[[Any, str], None]] = {
    "AamState": _check_aam,
    "EventCounts": _check_event_counts,
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
    check_process_states(parts, configuration)


def check_process_states(parts: Mapping[str, Any], configuration: Configuration) -> None:
    """Check that states have the same maps, those of the processes and whatever else has maps.

    :param parts: {part of the state: value}, each of which is checked; slam is one of them.
    :param configuration: of the run that saved them.
    :raises HmtSlamError: names the part that differs from that of slam.
    """
    for name, part in parts.items():
        if hasattr(part, "replica"):
            _check_same_map(part.replica, parts["slam"].replica, f"{name}.replica")
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


def check_slam_state(state: Any, configuration: Configuration, events: int | None = None) -> None:  # noqa: ANN401
    """Check that the grids of metric SLAM have the size that the parameters say.

    :param events: number of keyframe events that all nodes count on from, None where it is not known.
    :raises HmtSlamError: where they have another.
    """
    if events is not None:
        require(state.keyframe_events == events, "chain.events", events, f"{state.keyframe_events}, as of slam")
    local_map, particles = configuration.local_map, configuration.filter.particles
    table = 2 * math.ceil(local_map.extent / (_PATCH * local_map.cell))
    for hypothesis, own in state.live_hypotheses.items():
        grids = own.particle_filter
        if grids is not None:
            path = f"slam.live_hypotheses[{hypothesis}].particle_filter.tables"
            wanted = (particles, table, table)
            require(grids.tables.shape == wanted, path, f"of shape {grids.tables.shape}", f"of shape {wanted}")
