"""Domains in which nobody else is."""

import socket

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.ros import domain as domains
from hmt_slam_ros.ros.domain import own_domain


def test_two_at_a_time_get_different_domains():
    with own_domain() as first, own_domain() as second:
        assert first != second
        assert 1 <= first <= 101


def test_a_domain_is_free_again_afterwards():
    with own_domain() as first:
        pass
    with own_domain() as second:
        assert second == first


def test_a_domain_with_a_participant_is_left_alone(monkeypatch):
    with own_domain() as free:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 7400 + 250 * free + 10))
        with own_domain() as other:
            assert other != free


def test_where_all_are_taken_it_is_reported(monkeypatch):
    monkeypatch.setattr(domains, "_DOMAINS", range(1, 2))
    monkeypatch.setattr(domains, "_is_silent", lambda _: False)
    with pytest.raises(domains.HmtSlamError, match="are in use"), own_domain():
        pass
