"""Settings of the site: `sphinx-build -W docs OUTPUT` makes it; no ROS and nothing of the package is imported."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.domains.python import ObjectEntry, PythonDomain
from sphinx.environment import BuildEnvironment

# A build makes millions of objects and keeps most of them: the garbage collector need not look so often.
gc.set_threshold(200_000, 20, 100)

FindObject = Callable[..., list[tuple[str, ObjectEntry]]]

PACKAGE = "hmt_slam_ros"


def own_path() -> Path:
    """Where this file is: rosdoc2 copies the pages elsewhere, and runs it from a file that names it."""
    path = Path(__file__).resolve()
    wrapped = re.search(r'exec\(open\("([^"]+)"\)', path.read_text(encoding="utf-8"))
    return path if wrapped is None else Path(wrapped[1])


ROOT = own_path().parents[1]

project = PACKAGE
author = "hmt_slam_ros contributors"
project_copyright = author
release = version = ElementTree.parse(ROOT / "package.xml").findtext("version", "")

extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
# A price is no formula: none in words that touch a digit.
myst_dmath_allow_digits = False

# Static analysis: the API pages need neither ROS nor numba. Without the extension the site lacks these pages alone.
HAS_API = find_spec("autoapi") is not None
if HAS_API:
    from astroid.brain import brain_numpy_ndarray
    from astroid.manager import AstroidManager

    class OtherPackages(set[str]):
        """Names of the modules that are neither of the package nor of Python."""

        def __contains__(self, module: object) -> bool:
            """Whether a module is of another package."""
            return str(module).partition(".")[0] not in {PACKAGE, *sys.stdlib_module_names}

    # The sources of numpy and rclpy are not parsed: the pages name what comes from there, and know nothing of it.
    AstroidManager.brain["module_denylist"] = OtherPackages()
    extensions += ["sphinx.ext.autodoc", "autoapi.extension"]
    # astroid parses its text of the class ndarray at every annotation that names it, for half of the build's time.
    brain_numpy_ndarray.extract_node = cache(brain_numpy_ndarray.extract_node)
# Of the whole package, or of one of its folders: the pages of all take most of the time of a build.
API_FOLDER = os.environ.get("HMT_DOCS_API", "")
autoapi_dirs = [str(ROOT / PACKAGE / API_FOLDER)]
autoapi_root = "reference/api"
autoapi_options = ["members", "undoc-members", "show-module-summary"]
autoapi_add_toctree_entry = False
autoapi_keep_files = False
autoapi_python_class_content = "class"

# The last two are what rosdoc2 adds: an index of its own, pages by sphinx-apidoc, which imports, and a copy of README.
exclude_patterns = ["_build", "Thumbs.db", ".DS_Store", "*.rst", "standard_docs"]
suppress_warnings = [
    # Constants that are assigned several at a time are not found by the static analysis.
    "autoapi.python_import_resolution",
    # Two classes of one name.
    "ref.python",
    # The list of all folders is not made for one.
    *(["toc.not_included"] if API_FOLDER else []),
]
# Blocks without a language are commands and their output.
highlight_language = "none"

html_theme = "alabaster"
html_title = "hmt_slam_ros"
# Where a module stands instead of all pages, which would take a sixth of the build's time.
html_sidebars = {"reference/api/**": ["about.html", "searchfield.html", "localtoc.html", "relations.html"]}
html_show_sourcelink = False
ALABASTER = {
    "description": "Hybrid metric-topological SLAM for ROS 2",
    "fixed_sidebar": True,
    "page_width": "1180px",
    "sidebar_width": "250px",
    "show_powered_by": False,
}


def drop_empty_globs(app: Sphinx, page: str, source: list[str]) -> None:
    """Leave patterns of tables of contents away that match nothing, of which Sphinx would warn."""
    folder = (Path(app.srcdir) / page).parent
    for pattern in re.findall(r"^([a-z]+/\S*\*\S*)\n", source[0], re.MULTILINE):
        if not any(folder.glob(f"{pattern}.*")):
            source[0] = source[0].replace(f"{pattern}\n", "")


def escape_bars(_app: Sphinx, _kind: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    """Take |x| in a docstring for an absolute value, not for a substitution of reST."""
    lines[:] = [re.sub(r"\|(\w+)\|", r"\|\1\|", line) for line in lines]


def find_documented(find: FindObject) -> FindObject:
    """Look only for names that end as one of the site's: Sphinx goes through all of them for each ``int``."""
    known: dict[int, set[str]] = {}

    def find_object(
        domain: PythonDomain,
        env: BuildEnvironment,
        module: str,
        class_: str,
        name: str,
        kind: str | None,
        mode: int = 0,
    ) -> list[tuple[str, ObjectEntry]]:
        if len(domain.objects) not in known:
            known.clear()
            known[len(domain.objects)] = {one.rpartition(".")[2] for one in domain.objects}
        if name.removesuffix("()").rpartition(".")[2] not in known[len(domain.objects)]:
            return []
        return find(domain, env, module, class_, name, kind, mode)

    return find_object


def choose_theme_options(_app: Sphinx, config: Config) -> None:
    """Give Sphinx's own theme its options; rosdoc2 takes another one."""
    if config.html_theme == "alabaster":
        config.html_theme_options = ALABASTER


def setup(app: Sphinx) -> None:
    """Connect all of them with Sphinx."""
    app.connect("config-inited", choose_theme_options)
    app.connect("source-read", drop_empty_globs)
    PythonDomain.find_obj = find_documented(PythonDomain.find_obj)
    if HAS_API:
        app.connect("autodoc-process-docstring", escape_bars)
