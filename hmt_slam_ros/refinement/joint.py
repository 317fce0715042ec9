"""Joint refinement of many scans: all overlapping pairs are registered at once, and the poses solved for together.

Iterates between two steps: every overlapping pair of scans is linearised at the present poses (point-to-line, so that
a pair in a bare corridor says nothing about the direction along it), which makes it an edge of a pose graph; the graph,
with the edges of the motion, is solved (Lu and Milios 1997).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.topological import Refinement
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.refinement.neighbours import Pairs
from hmt_slam_ros.refinement.registration import normal_equations, weighting
from hmt_slam_ros.refinement.surfaces import Surfaces
from hmt_slam_ros.topology.pose_graph import Edges, optimise, relative_covariances

# The graph changes with the next linearisation: it need not be solved to the last digit.
_TOLERANCE = 1e-3
# Before the last linearisation one out of so many points serves.
_THINNED = 2
# Keeps the information of a pair regular: 3 m and 3 rad.
_VAGUE = 0.1 * np.eye(3)
# The same where it is to say nothing, whatever the number of pairs: 1 km.
_NOTHING = 1e-6 * np.eye(3)
# A turn counts like the metres by which it moves a point 3 m away. Along a direction a pair tells something where its
# information is at least this share of the largest: normals are off by some hundredths.
_SCALE, _LEAST = np.array([1.0, 1.0, 1.0 / 3.0]), 0.004


def refine_jointly(
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    pairs: Pairs,
    motion: Edges,
    options: Refinement,
    fixed: int = 0,
) -> NDArray[np.float64]:
    """The poses that agree best with all registrations and the motion between them.

    :param surfaces: of n scans.
    :param poses: shape (n, 3), ``map_T_base`` to start from.
    :param pairs: scans that may overlap.
    :param motion: edges of the motion, which join all scans; they hold the directions that walls leave open.
    :param fixed: the scan that stays.
    :returns: shape (n, 3).
    """
    gates = np.geomspace(options.first_gate, options.last_gate, options.iterations)
    for k, gate in enumerate(gates.tolist(), start=1):
        every = _THINNED if k < len(gates) else 1
        edges = _with(motion, _registered(surfaces, poses, pairs, gate, every, options))
        poses = optimise(poses, edges, fixed, marginals=False, tolerance=_TOLERANCE).poses
    return poses


def relative_beliefs(
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    pairs: Pairs,
    motion: Edges,
    options: Refinement,
    between: NDArray[np.int64],
) -> list[PoseGaussian]:
    """How certain refined poses are relative to each other.

    Overlapping pairs see the same walls and are not independent, so only a share of their information counts. And noise
    of the normals has each pair tell a little of every direction, which adds up: what is so little does not count.

    :param poses: shape (n, 3), that registrations and motion agree on.
    :param motion: edges of the motion, all as uncertain as they are.
    :param between: shape (k, 2), scans i and j.
    :returns: beliefs over ``i_T_j``.
    """
    registered = _registered(surfaces, poses, pairs, options.last_gate, 1, options)
    information = options.certainty * _determined(_inverses(registered.covariances)) + _NOTHING
    edges = _with(motion, replace(registered, covariances=_inverses(information)))
    means = se2.between(poses[between[:, 0]], poses[between[:, 1]])
    return list(map(PoseGaussian, means, relative_covariances(poses, edges, between)))


def _inverses(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _determined(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information (m, 3, 3) without the directions of which there is next to none."""
    scale = np.outer(_SCALE, _SCALE)
    values, vectors = np.linalg.eigh(information * scale)
    kept = np.where(values > _LEAST * values[:, -1:], values, 0.0)
    found: NDArray[np.float64] = np.einsum("mij,mj,mkj->mik", vectors, kept, vectors) / scale
    return found


def _registered(
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    pairs: Pairs,
    gate: float,
    every: int,
    options: Refinement,
) -> Edges:
    """One Gauss-Newton step of every pair on its own, as edges from the second scan to the first."""
    one, other = pairs.rows.T
    relative = se2.between(poses[other], poses[one])
    information, gradient, share = normal_equations(
        surfaces, one, surfaces, other, relative, gate, weighting(options), every
    )
    meets = share >= pairs.least_share
    information = information[meets] + _VAGUE
    step = -np.linalg.solve(information, gradient[meets, :, None])[..., 0]
    return Edges(
        other[meets],
        one[meets],
        se2.compose(relative[meets], se2.exp(step)),
        np.linalg.inv(information),
    )


def _with(motion: Edges, registered: Edges) -> Edges:
    return Edges(
        np.concatenate((motion.sources, registered.sources)),
        np.concatenate((motion.targets, registered.targets)),
        np.concatenate((motion.poses, registered.poses)),
        np.concatenate((motion.covariances, registered.covariances)),
    )
