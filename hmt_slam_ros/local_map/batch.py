"""One filter step for all particles of a hypothesis, each against its own map, in a single compiled call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.geometry.symmetric import into_array, inverse, of_array, total
from hmt_slam_ros.local_map.matching import Alignment, BeamModel, Prior, align_into, evidence
from hmt_slam_ros.local_map.patches import MapView


class Proposals(NamedTuple):
    """The optimal proposals of m particles, in map coordinates.

    :ivar modes: shape (m, 3).
    :ivar hessians: information of the points at the modes, shape (m, 3, 3).
    :ivar covariances: shape (m, 3, 3).
    :ivar evidences: log p(z | x_{t-1}, u), shape (m,), nats.
    """

    modes: Float64
    hessians: Float64
    covariances: Float64
    evidences: Float64


@njit(cache=True)
def propose_all(
    points: Float64,
    still: Float64,
    starts: Float64,
    priors: Float64,
    information: Float64,
    tables: Int32,
    view: MapView,
    settings: Alignment,
    model: BeamModel,
    sharpness: float,
    temper: float,
) -> Proposals:
    """The optimal proposal of every particle, p(x_t | x_{t-1}, u, z, map), as a Gaussian around its mode.

    Its covariance is that of Gauss-Newton, which asks of each beam only what the surface that it hit can tell. The
    likelihood itself would not do: along a corridor it varies with the cells of the map, and not with the pose.

    :param points: surfels (n, 4), which all count as evidence.
    :param still: surfels (k, 4), those of them that are matched.
    :param starts: (m, 3) poses to start matching from; ``priors``: (m, 3) poses that odometry predicts.
    :param tables: (m, T, T), the particles' maps; ``view`` is any view of the same pool.
    :param sharpness: exponent on the likelihood in the proposal.
    :param temper: exponent on the likelihood in the evidence.
    """
    m = starts.shape[0]
    modes, hessians = np.empty((m, 3)), np.empty((m, 3, 3))
    covariances, evidences = np.empty((m, 3, 3)), np.empty(m)
    known = of_array(information)
    for i in range(m):
        own = MapView(tables[i], view.odds, view.field, view.cell, view.radius)
        prior = Prior(priors[i], information)
        align_into(still, starts[i], prior, own, settings, modes[i], hessians[i])
        into_array(inverse(total(known, of_array(hessians[i]), sharpness)), covariances[i])
    # In a loop of its own: together with two arrays of points the compiler makes the alignment half as fast.
    for i in range(m):
        own = MapView(tables[i], view.odds, view.field, view.cell, view.radius)
        prior = Prior(priors[i], information)
        evidences[i] = evidence(points, modes[i], hessians[i], prior, own, model, temper)
    return Proposals(modes, hessians, covariances, evidences)
