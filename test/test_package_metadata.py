"""The metadata of the package agree everywhere, and it contains what they promise."""

import ast
import configparser
import json
import os
import re
import subprocess
import sys
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

import hmt_slam_ros
from hmt_slam_ros.process_table import program_names

ROOT = Path(__file__).resolve().parent.parent
NODES = program_names()
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))


@pytest.fixture(scope="module")
def setup_arguments():
    """What setup.py hands to setuptools, read without installing anything."""
    script = (
        "import json, setuptools; setuptools.setup = lambda **arguments: print(json.dumps(arguments));"
        "exec(open('setup.py').read())"
    )
    result = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    return yaml.safe_load(result.stdout)


@pytest.fixture(scope="module")
def console_scripts(setup_arguments):
    """Command name to "module:function"."""
    return dict(line.split(" = ") for line in setup_arguments["entry_points"]["console_scripts"])


def package_xml():
    return ElementTree.parse(ROOT / "package.xml").getroot()


def test_package_xml_and_setup_py_and_the_module_agree_on_name_version_and_licence(setup_arguments):
    document = package_xml()
    assert document.findtext("version") == setup_arguments["version"] == hmt_slam_ros.__version__
    assert document.findtext("name") == setup_arguments["name"] == hmt_slam_ros.__name__
    assert document.findtext("license") == setup_arguments["license"] == "BSD-3-Clause"


def test_the_changelog_is_about_this_package_and_knows_its_version_or_what_is_to_come():
    text = (ROOT / "CHANGELOG.rst").read_text()
    assert "Changelog for package hmt_slam_ros" in text
    assert re.search(rf"^(Forthcoming|{re.escape(hmt_slam_ros.__version__)}\b.*)\n-+$", text, re.MULTILINE)


def test_setup_cfg_sends_colcons_executables_to_where_ros2_run_looks():
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    assert settings["install"]["install_scripts"] == settings["develop"]["script_dir"] == "$base/lib/hmt_slam_ros"


def test_every_command_on_path_is_prefixed_and_every_node_has_one(console_scripts):
    assert set(console_scripts) == {"hmt_slam", *(f"hmt_slam_{node}" for node in NODES)}


@pytest.mark.parametrize("command", ["hmt_slam", *(f"hmt_slam_{node}" for node in NODES)])
def test_every_command_leads_to_a_function_that_can_be_called(console_scripts, command):
    module, function = console_scripts[command].split(":")
    if ".ros." in module:
        pytest.importorskip("rclpy", reason="the nodes need rclpy, which is not installed here")
    assert callable(getattr(import_module(module), function))


@pytest.mark.parametrize("node", NODES)
def test_ros2_run_finds_an_executable_that_runs_the_node_of_its_name(setup_arguments, node, tmp_path):
    installed = dict(setup_arguments["data_files"])["lib/hmt_slam_ros"]
    source = ROOT / next(file for file in installed if Path(file).name == node)
    assert os.access(source, os.X_OK)
    package = tmp_path / "hmt_slam_ros" / "ros"
    package.mkdir(parents=True)
    (package.parent / "process_settings.py").symlink_to(ROOT / "hmt_slam_ros" / "process_settings.py")
    (package / "run_node.py").write_text("def run_node(name):\n    print(f'this is {name}')\n")
    executable = tmp_path / node
    executable.write_bytes(source.read_bytes())
    result = subprocess.run(
        [sys.executable, executable],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout == f"this is {node}\n"


def test_the_installed_files_exist_and_hold_marker_launch_configuration_and_the_bundled_log(setup_arguments):
    installed = dict(setup_arguments["data_files"])
    assert all((ROOT / file).is_file() for files in installed.values() for file in files)
    names = {f"{folder}/{Path(file).name}" for folder, files in installed.items() for file in files}
    share = "share/hmt_slam_ros"
    assert names >= {
        "share/ament_index/resource_index/packages/hmt_slam_ros",
        f"{share}/package.xml",
        f"{share}/launch/mapping.launch.py",
        f"{share}/launch/replay.launch.py",
        f"{share}/config/hmt_slam.yaml",
        f"{share}/config/hmt_slam.rviz",
        f"{share}/config/foxglove_layout.json",
        f"{share}/examples/graph_consumer.cpp",
        f"{share}/schemas/topology.schema.json",
        f"{share}/data/malaga_one_loop/metadata.yaml",
        f"{share}/data/malaga_one_loop/README.md",
    }
    assert any(name.endswith(".mcap") for name in names)


def test_the_files_of_the_page_are_installed_with_the_package(setup_arguments):
    patterns = setup_arguments["package_data"]["hmt_slam_ros"]
    package = ROOT / "hmt_slam_ros"
    names = {path.name for pattern in patterns for path in package.glob(pattern)}
    assert names >= {"py.typed", "index.html", "view.css", "view.js", "draw.js"}
    assert {path.parent.name for path in package.rglob("*.html")} == {"page"}


def test_every_package_with_modules_is_installed(setup_arguments):
    folders = {path.parent for path in (ROOT / "hmt_slam_ros").rglob("*.py")}
    assert set(setup_arguments["packages"]) == {".".join(folder.relative_to(ROOT).parts) for folder in folders}


def imported_names(files):
    trees = [ast.parse(file.read_text()) for file in files]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    absolute = [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level]
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return {name.split(".")[0] for name in absolute + plain}


@pytest.fixture(scope="module")
def python_packages(setup_arguments):
    """The modules of the packages that pip is to install."""
    names = (re.split(r"[<>=]", requirement)[0] for requirement in setup_arguments["install_requires"])
    return {{"PyYAML": "yaml", "Pillow": "PIL"}.get(name, name) for name in names}


def test_every_third_party_import_is_a_declared_dependency(python_packages):
    imported = imported_names((ROOT / "hmt_slam_ros").rglob("*.py"))
    ros = {element.text for element in package_xml().findall("exec_depend")}
    # _typeshed exists for type checkers only; rosbags itself requires lz4 and one of the two others.
    others = {"hmt_slam_ros", "_typeshed", "lz4", "backports", "zstandard"}
    assert imported - set(sys.stdlib_module_names) - others <= ros | python_packages


def test_pip_and_rosdep_request_the_same_python_packages_but_for_those_that_debian_does_not_have(python_packages):
    keys = {str(element.text) for element in package_xml().findall("exec_depend")}
    rosdep = {key.removeprefix("python3-") for key in keys if key.startswith("python3-")}
    assert {name.lower() for name in python_packages} == rosdep | {"numba", "rosbags"}


@pytest.mark.parametrize(
    "requirement", ["numpy", "scipy", "networkx", "numba", "matplotlib", "Pillow", "rosbags", "PyYAML"]
)
def test_the_floor_that_is_tested_is_the_floor_that_setup_py_promises(setup_arguments, requirement):
    promised = next(line for line in setup_arguments["install_requires"] if line.startswith(requirement))
    floor = (ROOT / "requirements" / "floor.txt").read_text()
    tested = re.search(rf"^{requirement}==([\d.]+)", floor, re.MULTILINE)
    assert tested
    assert f"{tested[1]}.".startswith(f"{promised.split('>=')[1]}.")


def test_the_installed_distribution_is_this_checkout():
    try:
        installed = metadata.version("hmt_slam_ros")
    except metadata.PackageNotFoundError:
        pytest.skip("hmt_slam_ros is used from the source tree, not installed")
    assert installed == hmt_slam_ros.__version__


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_file_compiles_and_starts_executables_that_exist(path):
    tree = ast.parse(path.read_text(), filename=str(path))
    assert any(isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description" for node in tree.body)
    literals = {
        keyword.value.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "executable" and isinstance(keyword.value, ast.Constant)
    }
    assert literals <= {*NODES, "rviz2"}


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_file_describes_its_arguments(path):
    if find_spec("launch_ros") is None:
        pytest.skip("launch_ros is not installed: it comes with a ROS installation, PyPI does not have it")
    namespace = {}
    exec(compile(path.read_text(), str(path), "exec"), namespace)
    described = {argument.name for argument in namespace["generate_launch_description"]().get_launch_arguments()}
    topics = {"scan_topic", "scan_topics", "odom_topic", "clock_topic"}
    frames = {"map_frame", "odom_frame", "base_frame"}
    assert {"params_file", "namespace", "save_to", *topics, *frames} <= described


NOTE_PARAMETERS = """#!{python}
import json, sys
from pathlib import Path
import yaml
found = {{}}
for path in (sys.argv[k + 1] for k, word in enumerate(sys.argv) if word == "--params-file"):
    for section in yaml.safe_load(Path(path).read_text()).values():
        found |= section["ros__parameters"]
(Path({folder!r}) / Path(sys.argv[0]).name).write_text(json.dumps(found))
"""
"""An executable that notes the parameters which launch gives it, the last ones in files."""


@pytest.mark.parametrize(
    ("arguments", "of_robot"), [([], None), (["scan_topics:=front,rear"], "front,rear")], ids=["one", "several"]
)
def test_a_replay_reads_several_topics_and_maps_the_one_of_the_robot(setup_arguments, tmp_path, arguments, of_robot):
    if find_spec("launch_ros") is None:
        pytest.skip("launch_ros is not installed: it comes with a ROS installation, PyPI does not have it")
    prefix, notes = tmp_path / "prefix", tmp_path / "notes"
    notes.mkdir()
    for folder, files in setup_arguments["data_files"]:
        (prefix / folder).mkdir(parents=True, exist_ok=True)
        for file in files:
            (prefix / folder / Path(file).name).write_bytes((ROOT / file).read_bytes())
    for node in NODES:
        executable = prefix / "lib" / "hmt_slam_ros" / node
        executable.write_text(NOTE_PARAMETERS.format(python=sys.executable, folder=str(notes)))
        executable.chmod(0o755)
    script = (
        "import sys; from launch import LaunchDescription, LaunchService; from launch.actions import *;"
        "from launch.launch_description_sources import PythonLaunchDescriptionSource as Source;"
        "service = LaunchService(); words = [tuple(word.split(':=')) for word in sys.argv[2:]];"
        "included = IncludeLaunchDescription(Source(sys.argv[1]), launch_arguments=words);"
        "service.include_launch_description(LaunchDescription([included])); sys.exit(service.run())"
    )
    path = prefix / "share" / "hmt_slam_ros" / "launch" / "replay.launch.py"
    environment = os.environ | {"ROS_LOG_DIR": str(tmp_path / "log")}
    environment["AMENT_PREFIX_PATH"] = f"{prefix}:{os.environ.get('AMENT_PREFIX_PATH', '')}"
    subprocess.run([sys.executable, "-c", script, path, *arguments], env=environment, check=True, timeout=60)
    parameters = {path.name: json.loads(path.read_text()) for path in notes.iterdir()}
    assert parameters["slam"]["sensors.scan_topics"] == "scan"
    assert parameters["robot"].get("sensors.scan_topics") == of_robot


def topics_of_the_nodes():
    """Every topic of the nodes with a slash before it."""
    pytest.importorskip("rclpy", reason="the nodes need rclpy, which is not installed here")
    topics = import_module("hmt_slam_ros.ros.topics")
    names = {value for name, value in vars(topics).items() if name.isupper() and isinstance(value, str)}
    return {f"/{name.lstrip('/')}" for name in names | {*topics.DOCUMENTS.values(), *topics.ROOMS.values()}}


SHOWN = {"/map", "/hmt/graph", "/hmt/landmarks", "/explorer/rooms", "/pilot/rooms"}
SHOWN |= {"/hmt/path", "/hmt/particles", "/pose", "/scan"}


def test_rviz_shows_the_topics_the_nodes_publish():
    manager = yaml.safe_load((ROOT / "config" / "hmt_slam.rviz").read_text())["Visualization Manager"]
    topics = {display["Topic"]["Value"] for display in manager["Displays"] if "Topic" in display}
    assert topics == SHOWN
    tools = {tool["Topic"]["Value"] for tool in manager["Tools"] if "Topic" in tool}
    assert tools == {"/initialpose"}
    assert topics | tools <= topics_of_the_nodes()
    graph = next(display for display in manager["Displays"] if display["Name"] == "Areas and arcs")
    assert set(graph["Namespaces"]) == {"areas", "labels", "arcs", "closures", "area_uncertainty", "arc_uncertainty"}


def panels_of(layout):
    return {layout} if isinstance(layout, str) else panels_of(layout["first"]) | panels_of(layout["second"])


def test_foxglove_shows_the_topics_the_nodes_publish():
    layout = json.loads((ROOT / "config" / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    assert panels_of(layout["layout"]) == set(panels)
    plan = panels["3D!plan"]
    assert set(plan["topics"]) == SHOWN
    paths = [line["value"] for panel in panels.values() for line in panel.get("paths", ())]
    plotted = {path.split(".")[0] for path in (*paths, panels["Indicator!localized"]["path"])}
    assert plotted == {"/hmt/pmf", "/hmt/entropy", "/hmt/is_localized"}
    reported = {panels["DiagnosticSummary!nodes"]["topicToRender"], plan["publish"]["poseEstimateTopic"]}
    assert plotted | set(plan["topics"]) | reported <= topics_of_the_nodes()


def test_the_package_has_every_file_of_the_page(setup_arguments):
    package = ROOT / "hmt_slam_ros"
    shipped = {path for pattern in setup_arguments["package_data"]["hmt_slam_ros"] for path in package.glob(pattern)}
    files = {path for path in (package / "view" / "page").rglob("*") if path.is_file()}
    assert {"uplot.js", "uplot.css", "uplot.license.txt", "index.html"} <= {path.name for path in files}
    assert files <= shipped
