"""A dated report: what was asked for and whether it holds, tables, pictures, and on what it was measured."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Requirement:
    """A figure that may not be larger than a bound, nor smaller than another.

    :ivar name: what is asked for.
    :ivar value: as measured; NaN, which meets nothing, where it could not be.
    :ivar bound: largest value that is allowed.
    :ivar unit: of both.
    :ivar least: smallest value that is allowed.
    """

    name: str
    value: float
    bound: float
    unit: str = ""
    least: float = -math.inf

    @property
    def met(self) -> bool:
        """Whether the figure is within its bounds."""
        return self.least <= self.value <= self.bound

    @property
    def row(self) -> list[str]:
        """The cells of its line in the table."""
        return [self.name, _number(self.value, self.unit), self._bounds, "pass" if self.met else "FAIL"]

    @property
    def _bounds(self) -> str:
        least, bound = _number(self.least, self.unit), _number(self.bound, self.unit)
        if math.isinf(self.least):
            return bound
        return f"at least {least}" if math.isinf(self.bound) else f"{least} to {bound}"


@dataclass
class Report:
    """What one measurement came to.

    :ivar kind: name of the measurement.
    :ivar title: headline.
    :ivar seeds: of the runs.
    :ivar requirements: in the order in which they are shown.
    :ivar body: Markdown under the requirements.
    :ivar data: everything, for programs; what JSON knows.
    :ivar pictures: {file name: caption}, of pictures in the report's folder.
    :ivar illustrations: file names of those that the documents show too.
    """

    kind: str
    title: str
    seeds: tuple[int, ...] = ()
    requirements: list[Requirement] = field(default_factory=list)
    body: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    pictures: dict[str, str] = field(default_factory=dict)
    illustrations: tuple[str, ...] = ()

    @property
    def met(self) -> bool:
        """Whether all that is asked for holds."""
        return all(requirement.met for requirement in self.requirements)

    @property
    def text(self) -> str:
        """Requirements and body as Markdown."""
        rows = [requirement.row for requirement in self.requirements]
        bounds = "at most" if all(math.isinf(requirement.least) for requirement in self.requirements) else "allowed"
        asked = [table(["required", "measured", bounds, ""], rows)] if rows else []
        return "\n\n".join([*asked, *self.body])

    def write(self, folder: Path, circumstances: Mapping[str, str]) -> None:
        """Write ``<kind>.md`` and ``<kind>.json``.

        :param circumstances: of the measurement: machine, versions, date.
        """
        facts = table(["", ""], [[name, value] for name, value in circumstances.items()])
        pictures = "\n\n".join(f"![{caption}]({name})\n\n{caption}" for name, caption in self.pictures.items())
        parts = [f"# {self.title}", self.text, pictures, "## Circumstances", facts]
        (folder / f"{self.kind}.md").write_text("\n\n".join(filter(None, parts)) + "\n", encoding="utf-8")
        content = {
            "kind": self.kind,
            "circumstances": dict(circumstances),
            "requirements": [vars(requirement) | {"met": requirement.met} for requirement in self.requirements],
            **self.data,
        }
        text = json.dumps(_plain(content), indent=1, allow_nan=False)
        (folder / f"{self.kind}.json").write_text(text + "\n", encoding="utf-8")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is of words, the others of figures."""
    rule = ["---", *("---:" for _ in head[1:])]
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, rule, *rows])


def _number(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".strip()


def _plain(value: Any) -> Any:  # noqa: ANN401  whatever is in a report
    """The same with None for numbers that JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
