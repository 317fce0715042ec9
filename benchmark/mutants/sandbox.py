"""A copy of the repository in which mutants are applied, one at a time, and tests run.

numba caches a kernel by the file that defines it, and does not notice that a kernel called from another file has
changed. So the cached kernels of the mutated module and of all modules that import it, directly or not, are put aside.
"""

from __future__ import annotations

import ast
import contextlib
import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from benchmark.logs import ROOT
from benchmark.mutants.mutations import Mutant
from hmt_slam_ros.errors import HmtSlamError

COPIED = ("hmt_slam_ros", "test", "benchmark", "config", "data", "launch", "scripts", "setup.cfg", "pyproject.toml")
"""What tests need of the repository."""

_PACKAGE = "hmt_slam_ros"


class TestRun(NamedTuple):
    """What the tests came to.

    :ivar status: "passed", "failed" or "timeout".
    :ivar seconds: they took.
    :ivar failed: the first test that failed, empty if none is named.
    :ivar output: the end of what pytest printed.
    """

    status: str
    seconds: float
    failed: str
    output: str


class Sandbox:
    """A copy of the repository.

    :ivar folder: of the copy.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._servers: dict[bool, _Server] = {}

    @cached_property
    def _importers(self) -> dict[str, set[str]]:
        return find_importers(self.folder / _PACKAGE)

    def refresh(self) -> None:
        """Bring the copy up to date. Files that are the same keep their time, and so their cached kernels."""
        command = ["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard", "--", *COPIED]
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        names = {name for name in listed if (ROOT / name).is_file()}
        for name in sorted(names):
            self._update(name)
        for folder in COPIED:
            for path in (self.folder / folder).rglob("*.py"):
                if path.relative_to(self.folder).as_posix() not in names:
                    path.unlink()

    def _update(self, name: str) -> None:
        source, target = ROOT / name, self.folder / name
        content = source.read_bytes()
        if target.exists() and target.read_bytes() == content:
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        if name.startswith(_PACKAGE + "/") and name.endswith(".py"):
            for kernel in self._kernels(name.removeprefix(_PACKAGE + "/")):
                kernel.unlink()

    @contextlib.contextmanager
    def apply(self, mutant: Mutant) -> Iterator[None]:
        """Apply a mutant until the block ends."""
        path = self.folder / _PACKAGE / mutant.module
        original, times = path.read_bytes(), path.stat()
        aside = self.folder / "aside"
        hidden = self._kernels(mutant.module) if changes_kernels(mutant) else []
        aside.mkdir(exist_ok=True)
        moved = [(kernel, aside / f"{n}") for n, kernel in enumerate(hidden)]
        for kernel, place in moved:
            kernel.rename(place)
        try:
            path.write_text(mutant.source, encoding="utf-8")
            yield
        finally:
            path.write_bytes(original)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            if changes_kernels(mutant):
                for kernel in self._kernels(mutant.module):
                    kernel.unlink()
            for kernel, place in moved:
                place.rename(kernel)

    def _kernels(self, module: str) -> list[Path]:
        """The cached kernels that depend on a module."""
        paths = [self.folder / _PACKAGE / each for each in reachable(self._importers, module)]
        return [
            kernel
            for path in paths
            for kernel in sorted((path.parent / "__pycache__").glob(f"{path.stem}.*"))
            if kernel.suffix in {".nbi", ".nbc"}
        ]

    def run_tests(self, files: Sequence[str], timeout: float, *, compiled: bool = True) -> TestRun:
        """Run some test files until the first failure.

        :param timeout: s.
        :param compiled: whether kernels are compiled, or interpreted.
        """
        arguments = [
            "-x",
            "-q",
            "--no-header",
            "--tb=line",
            "-p",
            "no:cacheprovider",
            *(f"test/{name}" for name in files),
        ]
        answer = self._server(compiled=compiled).request({"arguments": arguments, "timeout": timeout})
        status = {None: "timeout", 0: "passed"}.get(answer["status"], "failed")
        named = re.search(r"^(?:FAILED|ERROR) (\S+)", answer["output"], re.MULTILINE)
        return TestRun(status, answer["seconds"], named[1] if named else "", answer["output"])

    def _server(self, *, compiled: bool) -> _Server:
        if compiled not in self._servers:
            self._servers[compiled] = _Server(self.folder, compiled=compiled)
        return self._servers[compiled]

    def close(self) -> None:
        """End the processes that run tests."""
        for server in self._servers.values():
            server.close()
        self._servers.clear()


class _Server:
    """A process that runs tests, see `server.py`."""

    def __init__(self, folder: Path, *, compiled: bool) -> None:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
            "PYTHONDONTWRITEBYTECODE": "1",
            "NUMBA_DISABLE_JIT": "0" if compiled else "1",
        }
        command = [sys.executable, str(Path(__file__).with_name("server.py"))]
        self._process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def request(self, content: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request.

        :raises HmtSlamError: where the process has ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(content) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise HmtSlamError("the process that runs the tests ended: look at its messages above")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def changes_kernels(mutant: Mutant) -> bool:
    """Whether compiled kernels may depend on what a mutant changes.

    They do not depend on functions and classes without a decorator of numba.
    """
    mutated = ast.parse(mutant.source).body
    node = next((each for each in mutated if _first_line(each) <= mutant.line <= (each.end_lineno or 0)), None)
    if isinstance(node, ast.FunctionDef):
        return any("jit" in ast.unparse(each) for each in node.decorator_list)
    return not isinstance(node, ast.ClassDef)


def _first_line(node: ast.stmt) -> int:
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return min([node.lineno, *(each.lineno for each in decorators)])


def find_importers(package: Path) -> dict[str, set[str]]:
    """{module: those that import it}, as paths below the package."""
    importers: dict[str, set[str]] = defaultdict(set)
    for path in package.rglob("*.py"):
        for imported in _imported_modules(package, path):
            importers[imported].add(path.relative_to(package).as_posix())
    return importers


def reachable(importers: Mapping[str, set[str]], module: str) -> set[str]:
    """A module and those that import it, directly or not."""
    found, waiting = {module}, [module]
    while waiting:
        new = importers.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found


def _imported_modules(package: Path, path: Path) -> Iterable[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == package.name:
            folder = "/".join((node.module or "").split(".")[1:])
            yield from (_module_path(package, folder, alias.name) for alias in node.names)


def _module_path(package: Path, folder: str, name: str) -> str:
    """The module that ``from package.folder import name`` reads."""
    for candidate in (f"{folder}/{name}.py", f"{folder}.py", f"{folder}/__init__.py"):
        if (package / candidate.lstrip("/")).is_file():
            return candidate.lstrip("/")
    return ""
