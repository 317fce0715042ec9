"""The one configuration tree."""

from hmt_slam_ros.configuration.flat import (
    FlatParameter,
    as_flat,
    as_nested,
    flat_parameters,
    load_configuration,
    with_changes,
)
from hmt_slam_ros.configuration.tree import Configuration

__all__ = [
    "Configuration",
    "FlatParameter",
    "as_flat",
    "as_nested",
    "flat_parameters",
    "load_configuration",
    "with_changes",
]
