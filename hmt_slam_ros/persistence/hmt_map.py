"""The names of what makes a folder a saved map."""

FORMAT, VERSION = "hmt_map", 17

HMT_MAP = "hmt_map"
"""The folder in an output folder."""

CONFIGURATION = "configuration.yaml"
"""The file of its parameters."""
