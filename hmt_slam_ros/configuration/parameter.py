"""How one parameter is declared: default, unit, range and description in one place."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def parameter(
    default: Any,  # noqa: ANN401  bool, int, float or str
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:  # noqa: ANN401  type checkers are to see the default's type, not a Field
    """A dataclass field of the configuration tree.

    :param default: default value; its type (bool, int, float, str) is the parameter's type.
    :param description: one sentence, with the symbol of the literature where it has one.
    :param unit: SI unit or "".
    :param low: smallest value allowed, inclusive.
    :param high: largest value allowed, inclusive.
    :param choices: the words allowed, for a str.
    """
    return field(
        default=default,
        metadata={"description": description, "unit": unit, "low": low, "high": high, "choices": choices},
    )
