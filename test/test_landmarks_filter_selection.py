"""The kind of an area's local map, by a parameter or by what the area is."""

import numpy as np
import pytest
from worlds import box, drive, scan_in

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.line_filter import FilterSelector, LineFilter
from hmt_slam_ros.registration.consistency import Agreement, MapAgreement
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

WALLS = {ParticleFilter: box(-12.02, -1.03, 12.01, 1.02), LineFilter: box(-2.51, -2.03, 2.52, 2.01)}
TURN = np.array([0.0, 0.0, 0.3])


def mapping_of(kind):
    return LocalMapping(with_changes(Configuration(), {"local_map.kind": kind}))


def content(walls, area):
    """Keyframes of a drive to and fro."""
    poses = drive((-1.5, 0.2), (1.5, 0.2), (-1.5, 0.2))
    scans = [scan_in(walls, pose, beams=361, noise=0.01, seed=k) for k, pose in enumerate(poses)]
    return [PlacedKeyframe(k, area, scan, pose) for k, (scan, pose) in enumerate(zip(scans, poses, strict=True))]


@pytest.mark.parametrize(
    ("kind", "expected"), [("grid", ParticleFilter), ("lines", LineFilter), ("by_class", ParticleFilter)]
)
def test_the_parameter_chooses_the_kind(kind, expected):
    assert type(FilterSelector(mapping_of(kind)).new(0, 0)) is expected


@pytest.mark.parametrize("before", [ParticleFilter, LineFilter])
@pytest.mark.parametrize("after", [ParticleFilter, LineFilter])
def test_by_class_hallways_get_grids_and_rooms_lines_and_the_robot_goes_on_where_it_was(before, after):
    mapping, new_T_old = mapping_of("by_class"), np.array([-1.0, 0.5, 0.2])
    kinds, own, here = FilterSelector(mapping), before(mapping, 3, 0), np.array([0.4, 0.1, 0.1])
    own.initialize(PoseGaussian.from_pose(se2.compose(se2.inverse(new_T_old), here)))
    own.clutter_estimate = own.clutter_estimate.update(MapAgreement(Agreement(9, 3, 1), Agreement(4, 2, 1)))
    experience, loaded = own.clutter_estimate, content(WALLS[after], 7)
    elsewhere = content(WALLS[before], 0)
    entered = kinds.select(own, 7, [*elsewhere, *loaded])
    assert type(entered) is after
    assert (entered is own) == (before is after)
    entered.change_area(7, new_T_old, loaded)
    assert (entered.hypothesis, entered.area, entered.clutter_estimate) == (3, 7, experience)
    np.testing.assert_allclose(entered.pose, here, atol=1e-9)
    assert entered.keyframes == [placed.keyframe for placed in loaded]
    step = RelativeMotion(np.array([0.1, 0.05, 0.05]), np.diag([0.05, 0.05, 0.03]) ** 2)
    truth = se2.compose(here, TURN)
    sighting = PreparedScan(mapping, scan_in(WALLS[after], truth, beams=361, noise=0.01, seed=99))
    turned = RelativeMotion(TURN + np.array([0.04, -0.03, 0.02]), step.covariance)
    entered.track(sighting, Prediction(turned, turned, fused=turned))
    np.testing.assert_allclose(se2.between(truth, entered.pose)[1:], 0.0, atol=0.02)


@pytest.mark.parametrize("kind", ["grid", "lines"])
def test_a_kind_that_is_chosen_stays(kind):
    mapping = mapping_of(kind)
    own = FilterSelector(mapping).new(0, 0)
    assert all(FilterSelector(mapping).select(own, 7, content(walls, 7)) is own for walls in WALLS.values())


def test_an_area_of_which_too_little_is_known_gets_a_map_of_the_kind_that_is_there():
    mapping = mapping_of("by_class")
    own = LineFilter(mapping, 0, 0)
    assert FilterSelector(mapping).select(own, 7, content(WALLS[ParticleFilter], 0)) is own


def test_the_map_that_is_left_gives_its_patches_back():
    mapping = mapping_of("by_class")
    own = ParticleFilter(mapping, 0, 0)
    own.add_keyframe(0, content(WALLS[ParticleFilter], 0)[0].scan)
    assert mapping.pool.patches_in_use > 0
    FilterSelector(mapping).select(own, 7, content(WALLS[LineFilter], 7))
    assert mapping.pool.patches_in_use == 0
