"""Replay of several logs at once, each by the nodes of a robot in a namespace of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from threading import Event

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.team import TeamPlacement
from hmt_slam_ros.ros.node_processes import own_domain
from hmt_slam_ros.ros.replay import ReplayResult, ReplayRun, ReplayTeam, local_discovery


def replay_team(
    logs: Mapping[str, Path],
    configuration: Configuration,
    folder: Path,
    progress: Callable[[int], None] | None = None,
    view_port: int | None = None,
    on_placement: Callable[[TeamPlacement], None] | None = None,
) -> dict[str, ReplayResult]:
    """Replay several logs at once, each by the nodes of a robot in a namespace, in one domain.

    :param logs: {name of a robot: its log}.
    :param folder: in which each robot gets an output folder of its name.
    :param progress: called with the number of processed scans of all robots.
    :param view_port: port of the live page of the first robot, and of the others the ports after it; None for no page.
    :param on_placement: called with each new answer of a robot for itself and another one.
    :raises HmtSlamError: as :func:`replay`.
    """
    done = dict.fromkeys(logs, 0)

    def count(robot: str, scans: int) -> None:
        done[robot] = scans
        if progress is not None:
            progress(sum(done.values()))

    team = ReplayTeam(Event(), on_placement or (lambda _: None))
    runs = {
        name: ReplayRun(
            log,
            configuration,
            partial(count, name),
            view_port=None if view_port is None else view_port + number,
            robot=name,
            team=team,
        )
        for number, (name, log) in enumerate(logs.items())
    }
    with own_domain() as domain, local_discovery(), ThreadPoolExecutor(len(runs)) as pool:
        try:
            for ended in as_completed([pool.submit(run.run, domain) for run in runs.values()]):
                ended.result()
        except BaseException:
            team.is_given_up.set()
            raise
    results = {}
    for name, run in runs.items():
        (folder / name).mkdir()
        results[name] = run.write(folder / name)
    return results
