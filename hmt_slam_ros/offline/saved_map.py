"""The HMT map as a folder: written deterministically byte for byte, and read back complete.

manifest.json names format, version, seed, the robot's last pose and the probabilities; common.json holds the areas and
arcs that all hypotheses agree on, hypotheses.json what each changes, global.json ``map_T_area`` of the most probable
one, configuration.yaml the parameters (it serves as ``--config``), scans/*.npy the scans of the keyframes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.configuration.documents import ros_yaml
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.offline.recorder import Recording
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.topology.common_map import ArcValue
from hmt_slam_ros.topology.hybrid_map import HybridMap

FORMAT, VERSION = "hmt_map", 3
MANIFEST = "manifest.json"

# Columns of scans/geometry.npy after which the laser's pose (x, y, theta) follows.
_GEOMETRY = ("angle_min", "angle_increment", "range_min", "range_max", "time_increment")


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map as read back.

    :ivar replica: scans and maps of the live hypotheses with their probabilities.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar configuration: that of the run.
    """

    replica: Replica
    area_poses: dict[int, PoseGaussian]
    configuration: Configuration


def write_saved_map(directory: Path, recording: Recording, configuration: Configuration) -> None:
    """Write the map of a run into a folder that is made."""
    replica = recording.replica
    scans = {keyframe: replica.scans[keyframe] for keyframe in _mapped_keyframes(replica.maps.values())}
    directory.mkdir()
    write_json(directory / MANIFEST, _manifest(recording, configuration, len(scans)))
    write_json(directory / "common.json", _map_content(*_common_part(recording.hybrid_map)))
    write_json(
        directory / "hypotheses.json",
        [
            {
                "id": hypothesis,
                "robot_area": replica.areas[hypothesis],
                "probability": replica.probabilities[hypothesis],
            }
            | _map_content(hybrid_map.areas, {pair: arc for pair, arc in hybrid_map.arcs.items() if arc is not None})
            | {"withdrawn": sorted([a, b] for (a, b), arc in hybrid_map.arcs.items() if arc is None)}
            for hypothesis, hybrid_map in sorted(replica.maps.items())
        ],
    )
    write_json(
        directory / "global.json",
        [{"area": area} | _belief_content(pose) for area, pose in sorted(recording.area_poses.items())],
    )
    (directory / "configuration.yaml").write_text(ros_yaml(configuration), encoding="utf-8")
    _write_scans(directory / "scans", scans)


def read_saved_map(directory: Path) -> SavedMap:
    """Read a map back.

    :raises HmtSlamError: where the folder holds no map, one of another version, or a damaged one.
    """
    try:
        manifest = read_json(directory / MANIFEST)
        if (manifest["format"], manifest["version"]) != (FORMAT, VERSION):
            raise HmtSlamError(
                f"{directory} is of version {manifest['version']}, this program reads {VERSION}: map the log again"
            )
        return SavedMap(
            _read_replica(directory),
            {entry["area"]: _belief(entry) for entry in read_json(directory / "global.json")},
            load_configuration(directory / "configuration.yaml"),
        )
    except (OSError, ValueError, KeyError, TypeError, IndexError) as fault:
        raise HmtSlamError(f"{directory} holds no complete HMT map: map the log again") from fault


def write_json(path: Path, content: object) -> None:
    """Write JSON that is the same byte for byte for the same content."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:  # noqa: ANN401  whatever the document holds
    """Read a JSON document."""
    return json.loads(path.read_text(encoding="utf-8"))


def _manifest(recording: Recording, configuration: Configuration, keyframes: int) -> dict[str, Any]:
    last = recording.last
    return {
        "format": FORMAT,
        "version": VERSION,
        "seed": configuration.seed,
        "keyframes": keyframes,
        "areas": len(recording.area_poses),
        "most_probable": recording.replica.best,
        "robot": {"stamp": last.stamp, "area": last.area} | _belief_content(last.pose),
    }


def _mapped_keyframes(maps: Iterable[HybridMap]) -> list[int]:
    return sorted({keyframe for m in maps for area in m.area_ids() for keyframe in m.keyframes(area)})


def _common_part(
    hybrid_map: HybridMap,
) -> tuple[dict[int, Mapping[int, NDArray[np.float64]]], dict[tuple[int, int], ArcValue]]:
    common = HybridMap(hybrid_map.common)
    return (
        {area: common.keyframes(area) for area in common.area_ids()},
        {(a, b): arc for a, b, arc in common.all_arcs()},
    )


def _map_content(
    areas: Mapping[int, Mapping[int, NDArray[np.float64]]], arcs: Mapping[tuple[int, int], ArcValue]
) -> dict[str, Any]:
    return {
        "areas": [
            {"id": area, "keyframes": [{"id": k, "pose": pose.tolist()} for k, pose in keyframes.items()]}
            for area, keyframes in sorted(areas.items())
        ],
        "arcs": [
            {"source": a, "target": b, "closure": arc.closure} | _belief_content(arc.pose)
            for (a, b), arc in sorted(arcs.items())
        ],
    }


def _belief_content(belief: PoseGaussian) -> dict[str, Any]:
    return {"pose": belief.mean.tolist(), "covariance": belief.covariance.tolist()}


def _belief(content: Mapping[str, Any]) -> PoseGaussian:
    return PoseGaussian(np.array(content["pose"]), np.array(content["covariance"]))


def _write_scans(directory: Path, scans: Mapping[int, Scan]) -> None:
    directory.mkdir()
    rows = list(scans.values())
    arrays: dict[str, NDArray[Any]] = {
        "keyframes": np.array(list(scans), dtype=np.int64),
        "stamps": np.array([scan.stamp for scan in rows], dtype=np.int64),
        "beams": np.array([scan.ranges.size for scan in rows], dtype=np.int64),
        "geometry": np.array([[getattr(scan, name) for name in _GEOMETRY] for scan in rows], dtype=np.float64),
        "laser_poses": np.array([scan.laser_pose for scan in rows], dtype=np.float64),
        "motions": np.array([scan.motion for scan in rows], dtype=np.float64),
        "ranges": np.concatenate([scan.ranges for scan in rows]).astype(np.float32, copy=False),
    }
    for name, array in arrays.items():
        np.save(directory / f"{name}.npy", array)


def _read_scans(directory: Path) -> dict[int, Scan]:
    arrays = {
        name: np.load(directory / f"{name}.npy")
        for name in ("keyframes", "stamps", "beams", "geometry", "laser_poses", "motions", "ranges")
    }
    ends = np.cumsum(arrays["beams"])[:-1]
    return {
        int(keyframe): Scan(
            stamp=int(stamp),
            ranges=ranges,
            laser_pose=laser_pose,
            motion=motion,
            **dict(zip(_GEOMETRY, geometry, strict=True)),
        )
        for keyframe, stamp, ranges, geometry, laser_pose, motion in zip(
            arrays["keyframes"],
            arrays["stamps"],
            np.split(arrays["ranges"], ends),
            arrays["geometry"].tolist(),
            arrays["laser_poses"],
            arrays["motions"],
            strict=True,
        )
    }


def _read_replica(directory: Path) -> Replica:
    common = _read_map(read_json(directory / "common.json"), HybridMap())
    common.absorb()
    replica = Replica(_read_scans(directory / "scans"), {}, {}, {})
    for entry in read_json(directory / "hypotheses.json"):
        hybrid_map = replica.maps[entry["id"]] = _read_map(entry, HybridMap(common.common))
        for a, b in entry["withdrawn"]:
            hybrid_map.remove_arc(a, b)
        replica.probabilities[entry["id"]] = entry["probability"]
        replica.areas[entry["id"]] = entry["robot_area"]
    return replica


def _read_map(content: Mapping[str, Any], hybrid_map: HybridMap) -> HybridMap:
    for area in content["areas"]:
        hybrid_map.areas[area["id"]] = {entry["id"]: np.array(entry["pose"]) for entry in area["keyframes"]}
    for arc in content["arcs"]:
        hybrid_map.set_arc(arc["source"], arc["target"], _belief(arc), closure=arc["closure"])
    return hybrid_map
