"""The locked requirements hold all that the project asks for, once, with hashes."""

import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
LOCKED = ("tested", "ros", "tf2_msgs")
# Names of rosdep that are not those of PyPI.
PYPI_NAMES = {"pil": "pillow", "yaml": "pyyaml"}
# PyPI does not have these; the first two are compiled, the others start and show nodes.
NOT_ON_PYPI = {"tf2_msgs", "nav2_msgs", "launch", "launch_ros", "ros2launch"}


def locked_packages(name):
    """{package: requirements}: a package may have two versions with different markers."""
    text = (ROOT / "requirements" / f"{name}.txt").read_text()
    entries = re.split(r"^(?=[a-z0-9])", text, flags=re.MULTILINE)[1:]
    packages = {}
    for entry in entries:
        requirement = Requirement(entry.partition("\\")[0])
        hashes = re.findall(r"--hash=sha256:[0-9a-f]{64}(?= |$)", entry, flags=re.MULTILINE)
        assert hashes, requirement
        packages.setdefault(canonicalize_name(requirement.name), []).append(requirement)
    return packages


def version(requirement):
    """The only version that a locked requirement admits."""
    (specifier,) = requirement.specifier
    assert specifier.operator == "=="
    return Version(specifier.version)


def requirements_in(name):
    lines = (ROOT / "requirements" / f"{name}.in").read_text().splitlines()
    return [Requirement(line) for line in lines if not line.startswith("#")]


def assert_covers(packages, requirements):
    for requirement in requirements:
        pinned = packages[canonicalize_name(requirement.name)]
        assert all(requirement.specifier.contains(version(one)) for one in pinned), requirement


@pytest.mark.parametrize("name", LOCKED)
def test_a_locked_file_covers_what_its_source_asks_for(name):
    assert_covers(locked_packages(name), requirements_in(name))


def test_the_lock_covers_setup_py():
    script = (
        "import json, setuptools; setuptools.setup = lambda **arguments: print(json.dumps(arguments));"
        "exec(open('setup.py').read())"
    )
    result = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    arguments = json.loads(result.stdout)
    requirements = [*arguments["install_requires"], *arguments["extras_require"]["test"]]
    assert_covers(locked_packages("tested"), map(Requirement, requirements))
    # Without build isolation the project is installed by what the environment has.
    assert "setuptools" in locked_packages("tested")


def test_the_lock_covers_package_xml():
    packages = {name for file in LOCKED for name in locked_packages(file)}
    for element in ElementTree.parse(ROOT / "package.xml").getroot():
        if not element.tag.endswith("_depend") or element.text in NOT_ON_PYPI:
            continue
        name = element.text.removeprefix("python3-")
        is_ros = name == element.text
        assert (f"ros-{name.replace('_', '-')}" if is_ros else PYPI_NAMES.get(name, name)) in packages


def test_no_two_locked_files_disagree_on_a_version():
    files = [locked_packages(name) for name in LOCKED]
    for name in set().union(*files):
        versions = {tuple(sorted(map(version, file[name]))) for file in files if name in file}
        assert len(versions) == 1, name
