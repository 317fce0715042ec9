"""The picture of a map with a lost robot: its extent, its ellipses, and pieces whose place is unknown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import StampedPoses, write_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, OccupancyImage, occupancy_image, write_map
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.results.hmt_map import MapWriter, SavedMap, read_saved_map
from hmt_slam_ros.results.pieces import split_map
from hmt_slam_ros.results.plots import _break_at_jumps, _draw_piece, plot_map
from hmt_slam_ros.results.trajectories import RelativeTrajectory

FRAMES = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [2.0, 1.0, 0.5], [4.0, 1.0, 0.5]])
KNOWN = 1e-2 * np.eye(3)
HUGE = np.diag([400.0, 900.0, 1.0])
ANYWHERE = uninformative_belief(np.zeros(3)).covariance
ROOM = box(-3.0, -3.0, 8.0, 3.0)


def hybrid_map_of(count: int) -> HybridMap:
    """Areas with a keyframe each: 0 and 1, and 2 and 3, are joined; nothing is known between 1 and 2."""
    hybrid_map = HybridMap()
    for area in range(count):
        hybrid_map.set_keyframe(10 + area, area, np.zeros(3))
    for a, covariance in enumerate([KNOWN, ANYWHERE, KNOWN][: count - 1]):
        arc = PoseGaussian(se2.between(FRAMES[a], FRAMES[a + 1]), covariance)
        hybrid_map.set_arc(a, a + 1, arc, closure=False)
    return hybrid_map


def make_folder(folder: Path, *covariances: np.ndarray) -> SavedMap:
    """What is drawn of an output folder, with the covariances of the areas' poses in the map."""
    folder.mkdir(exist_ok=True)
    count = len(covariances)
    poses = np.array([FRAMES[0], FRAMES[1], FRAMES[0], FRAMES[1]])[:count]
    scans = {10 + k: scan_in(ROOM, pose, stamp=10**9 * (k + 1)) for k, pose in enumerate(poses)}
    replica = Replica(scans, {0: hybrid_map_of(count)}, {0: 1.0}, {0: count - 1})
    beliefs = {area: PoseGaussian(FRAMES[area], covariance) for area, covariance in enumerate(covariances)}
    writer = MapWriter(folder / "hmt_map")
    last = LocalEstimate(10**9 * count, count - 1, count - 1, beliefs[count - 1], FRAMES[count - 1], 0)
    writer.write_map(replica, beliefs, last, RelativeTrajectory(10 + np.arange(count), np.zeros((count, 3))))
    writer.finish(Configuration())
    write_map(folder, occupancy_image(list(scans.values()), FRAMES[:count], 0.05, 20.0))
    write_tum(folder / "trajectory.tum", StampedPoses(10**9 * np.arange(1, count + 1), FRAMES[:count]))
    return read_saved_map(folder / "hmt_map")


def draw(folder: Path, *covariances: np.ndarray) -> tuple[Figure, np.ndarray, OccupancyImage]:
    """The drawn map of one piece: figure, gray values and grid."""
    saved = make_folder(folder, *covariances)
    (piece,) = split_map(folder, saved, FRAMES[: len(covariances)])
    figure = Figure(figsize=(4.0, 4.0))
    _draw_piece(figure.add_subplot(), saved.replica.maps[0], piece)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return figure, np.asarray(canvas.buffer_rgba())[..., :3], piece.image


def hatches(figure: Figure) -> list[str | None]:
    return [patch.get_hatch() for patch in figure.axes[0].patches]


def test_no_line_leads_from_where_the_robot_was_taken_to_where_it_was_put() -> None:
    driven = np.array([[0.1 * step, 0.0, 0.0] for step in range(5)])
    trajectory = np.concatenate([driven, driven + np.array([9.0, 4.0, 1.0])])
    broken = _break_at_jumps(trajectory)
    assert np.flatnonzero(np.isnan(broken).any(axis=1)).tolist() == [5]
    np.testing.assert_array_equal(_break_at_jumps(driven), driven)


def test_the_extent_is_that_of_the_map_however_large_an_ellipse_is(tmp_path: Path) -> None:
    small, _, image = draw(tmp_path / "small", KNOWN, KNOWN)
    large, _, _ = draw(tmp_path / "large", KNOWN, HUGE)
    left, right = large.axes[0].get_xlim()
    assert (left, right) == small.axes[0].get_xlim()
    assert right - left == pytest.approx(image.pixels.shape[1] * image.resolution)
    assert large.axes[0].get_ylim() == small.axes[0].get_ylim()


def test_only_an_ellipse_that_exceeds_the_map_is_hatched_and_it_has_no_fill(tmp_path: Path) -> None:
    assert hatches(draw(tmp_path / "small", KNOWN, KNOWN)[0]) == [None, None]
    figure, _, _ = draw(tmp_path / "large", KNOWN, HUGE)
    assert hatches(figure) == [None, None, "////"]
    within, outline, hatch = figure.axes[0].patches
    assert [patch.get_facecolor()[3] for patch in (within, outline, hatch)] == [0.25, 0.0, 0.0]
    label = figure.axes[0].get_legend_handles_labels()[1][-1]
    assert label == "area, 95 % ellipse, hatched where it exceeds the map"


def test_the_hatching_is_along_the_frame_and_the_map_stays_visible(tmp_path: Path) -> None:
    _, plain, _ = draw(tmp_path / "plain", KNOWN, KNOWN)
    _, covered, _ = draw(tmp_path / "covered", HUGE, HUGE)
    changed = (plain != covered).any(axis=2)
    rows, columns = np.nonzero((plain == OCCUPIED).all(axis=2))
    top, bottom = rows.min(), rows.max()
    left, right = columns.min(), columns.max()
    assert changed[top : top + 8].any(axis=1).any()
    middle = changed[top + 20 : bottom - 20, left + 20 : right - 20]
    assert middle.mean() < 0.05  # the marks of the areas, and their ellipses in the plain picture


def test_walls_show_through_a_filled_ellipse(tmp_path: Path) -> None:
    saved = make_folder(tmp_path, KNOWN, KNOWN)
    (piece,) = split_map(tmp_path, saved, FRAMES[:2])
    pixels = np.full((200, 200), 254, np.uint8)
    pixels[100] = OCCUPIED
    drawn = Figure(figsize=(2.0, 2.0))
    piece = replace(
        piece,
        image=OccupancyImage(pixels, 0.1, np.array([-10.0, -10.0])),
        area_poses={0: PoseGaussian(np.zeros(3), 4.0 * np.eye(3))},
    )
    _draw_piece(drawn.add_axes((0.0, 0.0, 1.0, 1.0)), saved.replica.maps[0], piece)
    canvas = FigureCanvasAgg(drawn)
    canvas.draw()
    seen = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    assert drawn.axes[0].patches[0].get_facecolor()[3] == 0.25
    height, width = seen.shape[:2]
    at = [int(0.35 * width), int(0.4 * width)]
    assert (seen[height // 2 - 2 : height // 2 + 3, at].min(axis=0) == 0).all()


def test_a_scan_without_a_pose_is_in_the_area_of_the_one_before() -> None:
    scans = RelativeTrajectory(np.array([-1, 10, -1, 12, 13, -1]), np.zeros((6, 3)))
    assert scans.areas(hybrid_map_of(4)).tolist() == [0, 0, 0, 2, 3, 3]


def test_a_piece_of_unknown_place_has_its_own_frame_grid_and_path(tmp_path: Path) -> None:
    saved = make_folder(tmp_path, KNOWN, KNOWN, ANYWHERE, ANYWHERE)
    main, beside = split_map(tmp_path, saved, FRAMES)
    assert (list(main.area_poses), list(beside.area_poses)) == ([0, 1], [2, 3])
    np.testing.assert_array_equal(main.area_poses[1].covariance, KNOWN)
    np.testing.assert_allclose(beside.area_poses[2].mean, np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(beside.area_poses[3].mean, se2.between(FRAMES[2], FRAMES[3]))
    np.testing.assert_array_equal(beside.area_poses[3].covariance, KNOWN)
    np.testing.assert_array_equal(np.isnan(main.path[:, 0]), [False, False, True, True])
    np.testing.assert_array_equal(np.isnan(beside.path[:, 0]), [True, True, False, False])
    np.testing.assert_allclose(beside.path[3], se2.between(FRAMES[2], FRAMES[3])[:2])
    scans = [saved.replica.scans[keyframe] for keyframe in (10, 11)]
    alone = occupancy_image(
        scans, FRAMES[:2], saved.configuration.local_map.cell, saved.configuration.local_map.max_range
    )
    np.testing.assert_array_equal(main.image.pixels, alone.pixels)


def test_a_piece_of_unknown_place_is_drawn_beside_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_folder(tmp_path, KNOWN, KNOWN, ANYWHERE, ANYWHERE)
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    plot_map(tmp_path)
    drawn[0].canvas.draw()
    left, right = drawn[0].axes
    assert left.get_position().x1 < right.get_position().x0
    assert right.get_title() == "place unknown"
    assert left.get_title().startswith("areas: 4   arcs: 3")
    assert [text.get_text() for text in left.texts] == ["0", "1"]
    assert [text.get_text() for text in right.texts] == ["2", "3"]
    assert [patch.get_hatch() for axes in (left, right) for patch in axes.patches] == [None] * 4


def test_the_extent_has_the_keyframes_too(tmp_path: Path) -> None:
    """A laser in front of the robot may see nothing of where that stands."""
    saved = make_folder(tmp_path, KNOWN, KNOWN)
    (piece,) = split_map(tmp_path, saved, FRAMES[:2])
    low, high = piece.corners
    aside = replace(piece, keyframes={0: np.array([low - 7.0])})
    np.testing.assert_allclose(aside.corners, [low - 7.5, high])
