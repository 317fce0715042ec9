"""The HMT map: areas with keyframes, arcs between them, and where they lie in one frame."""
