"""How one parameter is declared: default, description, range and unit in one place."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def parameter(
    default: Any,  # noqa: ANN401  bool, int, float or str
    description: str,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
    *,
    choices: tuple[str, ...] = (),
    expert: bool = False,
) -> Any:  # noqa: ANN401  type checkers are to see the default's type, not a Field
    """A dataclass field of the configuration tree.

    :param default: default value; its type (bool, int, float, str) is the parameter's type.
    :param description: one sentence, with the symbol of the literature where it has one.
    :param low: smallest value allowed, inclusive.
    :param high: largest value allowed, inclusive.
    :param unit: SI unit or degrees, "" for none.
    :param choices: the words allowed, for a str.
    :param expert: whether it is a threshold that few robots need to change.
    """
    metadata = {
        "description": description,
        "low": low,
        "high": high,
        "unit": unit,
        "choices": choices,
        "expert": expert,
    }
    return field(default=default, metadata=metadata)
