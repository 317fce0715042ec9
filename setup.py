"""One description of the package for `colcon build` and for pip.

Colcon obeys setup.cfg and puts the console scripts into lib/hmt_slam_ros; pip puts them on PATH, which is why their
names start with hmt_slam. The short names of `ros2 run hmt_slam_ros slam` come from libexec/ as data files, so that
they never reach PATH.
"""

from pathlib import Path
from runpy import run_path

from setuptools import find_packages, setup

NAME = "hmt_slam_ros"
TABLE = run_path(f"{NAME}/process_table.py")
NODES = TABLE["program_names"]()
DOCS = ("myst-parser>=4.0", "sphinx>=8.1", "sphinx-autoapi>=3.4")
SHARED = ("launch", "config", "examples", "data/malaga_one_loop")


def files_in(folder: str) -> list[str]:
    """Return the files of a folder, relative to the repository, as setuptools and colcon want them."""
    return sorted(str(path) for path in Path(folder).glob("*") if path.is_file())


setup(
    name=NAME,
    version="0.1.0",
    description="Hybrid metric-topological SLAM for ROS 2",
    author="hmt_slam_ros contributors",
    license="BSD-3-Clause",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "kernel_table.txt", "view/page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", files_in(folder)) for folder in SHARED),
        (f"share/{NAME}/schemas", files_in("docs/reference/schemas")),
        (f"lib/{NAME}", [f"libexec/{node}" for node in NODES]),
    ],
    install_requires=[
        "matplotlib>=3.6",
        "networkx>=2.8",
        "numba>=0.59",
        "numpy>=1.26",
        "Pillow>=10.2",
        "PyYAML>=6.0",
        "rosbags>=0.11",
        "scipy>=1.11",
    ],
    extras_require={
        "docs": [*DOCS],
        "test": ["hypothesis", "import-linter", "jsonschema", "mypy", "pytest", "pytest-xdist", "ruff", *DOCS],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"hmt_slam = {NAME}.cli.main:main",
            *(f"hmt_slam_{node} = {TABLE['RUN_NODE']}:main" for node in NODES),
        ],
    },
)
