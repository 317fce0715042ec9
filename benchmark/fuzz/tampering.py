"""Maps whose values were changed such that each has its type: what only an attacker who knows the format writes.

Any value of any record may change: a number to a special one or to a number of another record, an array in its values
or in its length, a list by what it holds twice or no more, an absent record by a generated one. The map is written
again, with right checksums.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.results.hmt_map import PARTS, ChainState, MapDocument
from hmt_slam_ros.saved_map.field_limits import _COVARIANCES, _SHAPES, MAX_AREAS, MAX_COORDINATE, MAX_COUNT, MAX_STAMP
from hmt_slam_ros.saved_map.folder import CONFIGURATION, FORMAT, VERSION, FolderReader, FolderWriter
from hmt_slam_ros.sensors import Scan

ValuePath = tuple[Any, ...]
"""Fields, indices and keys from a document to a value in it."""

_KINDS: Mapping[str, type] = {**PARTS, "map": MapDocument, "chain": ChainState}

_INTEGERS = (-1, 0, 1, 2, 7, MAX_AREAS - 1, MAX_AREAS, MAX_COUNT, MAX_STAMP, -MAX_STAMP)
_FLOATS = (0.0, -0.0, 1e-300, -1e-300, 1e-9, 1.0, -1.0, 3.2, 1e3, MAX_COORDINATE, -MAX_COORDINATE, 1e15, -1e15)
_FACTORS = (-1.0, 0.0, 1e-12, 1e-3, 1e3, 1e6, 1e12)
_REPETITIONS = (2, 30, 1000)
_LARGEST_LIST = 100_000


@dataclasses.dataclass(frozen=True)
class _Place:
    """Where a value of a record is.

    :ivar path: of the value.
    :ivar owner: name of the record's class.
    :ivar field: name of the field.
    :ivar kind: its annotation.
    """

    path: ValuePath
    owner: str
    field: str
    kind: Any


class _Tamperer:
    """Changes the documents of a map."""

    def __init__(self, documents: dict[str, Any], changed: Iterable[str], rng: np.random.Generator) -> None:
        """:param changed: names of the documents that are changed."""
        self.documents, self._rng = documents, rng
        self._records: dict[type, list[Any]] = {}
        self._scans: list[Scan] = []
        self._integers: list[int] = []
        self._places: dict[tuple[str, str], list[_Place]] = {}
        for name in _KINDS:
            self._collect(documents[name], (name,), is_changed=name in changed)

    def _collect(self, value: Any, path: ValuePath, *, is_changed: bool) -> None:  # noqa: ANN401
        """Collect the records, scans and numbers in a value, and the places of all fields that may change."""
        if isinstance(value, Scan):
            self._scans.append(value)
            return
        kind: Any = type(value)
        if is_record(kind):
            self._records.setdefault(kind, []).append(value)
            hints = get_type_hints(kind)
            for name in field_names(kind):
                own = (kind.__name__, name)
                if is_changed:
                    self._places.setdefault(own, []).append(_Place((*path, name), *own, hints[name]))
                self._collect(getattr(value, name), (*path, name), is_changed=is_changed)
        elif isinstance(value, tuple | Mapping):
            for key, item in _items(value):
                self._collect(item, (*path, key), is_changed=is_changed)
        elif type(value) is int:
            self._integers.append(value)

    def tamper(self) -> None:
        """Change one value; at times alike in all documents that have a map."""
        groups = list(self._places.values())
        group = groups[self._rng.integers(len(groups))]
        place = group[self._rng.integers(len(group))]
        if isinstance(self._value(place.path), np.ndarray) and self._rng.random() < 0.3:
            self._resize(place)
        else:
            changed = self.change(self._value(place.path), place.kind, (place.owner, place.field))
            self._put(place.path, changed)
        if place.path[1] == "replica" and self._rng.random() < 0.7:
            replica = self.documents[place.path[0]].replica
            for name in _KINDS:
                if hasattr(self.documents[name], "replica") and (name != "map" or self._rng.random() < 0.5):
                    self.documents[name] = dataclasses.replace(self.documents[name], replica=replica)

    def _value(self, path: ValuePath) -> Any:  # noqa: ANN401
        value: Any = self.documents
        for step in path:
            value = getattr(value, step) if is_record(type(value)) else value[step]
        return value

    def _put(self, path: ValuePath, value: Any) -> None:  # noqa: ANN401
        self.documents = _replace_at(self.documents, path, value)

    def _resize(self, place: _Place) -> None:
        """Change the length of an array, and of all arrays of its record that have the same."""
        record = self._value(place.path[:-1])
        shapes = _SHAPES.get(place.owner, {})
        axes = [axis for axis, word in enumerate(shapes[place.field].split()) if not word.isdigit()]
        if not axes:
            return
        letter = shapes[place.field].split()[axes[self._rng.integers(len(axes))]]
        kind, factor = self._rng.integers(4), int(self._rng.choice(_REPETITIONS[:2]))
        for name, shape in shapes.items():
            array = getattr(record, name)
            for axis, word in enumerate(shape.split()):
                if word == letter:
                    array = _resize_array(array, axis, int(kind), factor)
            record = _replace_at(record, (name,), array)
        self._put(place.path[:-1], record)

    def change(self, value: Any, kind: Any, owner: tuple[str, str]) -> Any:  # noqa: ANN401, PLR0911  one case a return
        """Another value of the type."""
        if value is None:
            return self.generate(kind, owner)
        if type(None) in get_args(kind) and self._rng.random() < 0.2:
            return None
        if isinstance(value, np.ndarray):
            return self._change_array(value, owner[1])
        if isinstance(value, Scan):
            return self._change_scan(value)
        if is_record(type(value)):
            known = self._records.get(type(value), [])
            return known[self._rng.integers(len(known))] if known else value
        if isinstance(value, frozenset):
            return frozenset(self._change_items(tuple(value), kind, owner))
        if isinstance(value, tuple):
            return self._change_items(value, kind, owner)
        if isinstance(value, Mapping):
            return self._change_mapping(value, kind, owner)
        return self._change_scalar(value)

    def _change_scalar(self, value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, bool):
            return not value
        if isinstance(value, int):
            return self._integer(value)
        if isinstance(value, float):
            return float(value * self._rng.choice(_FACTORS)) if self._rng.random() < 0.4 else self._float()
        return value

    def _integer(self, near: int = 0) -> int:
        choice = self._rng.random()
        if choice < 0.4:
            return near + int(self._rng.integers(-2, 3))
        if choice < 0.75 and self._integers:
            return self._integers[self._rng.integers(len(self._integers))]
        return _INTEGERS[self._rng.integers(len(_INTEGERS))]

    def _float(self) -> float:
        return _FLOATS[self._rng.integers(len(_FLOATS))]

    def _change_items(self, items: tuple[Any, ...], kind: Any, owner: tuple[str, str]) -> tuple[Any, ...]:  # noqa: ANN401
        arguments = [argument for argument in get_args(_without_none(kind)) if argument is not Ellipsis]
        if not arguments:
            return items
        if not items or self._rng.random() < 0.2:
            return (*items, self.generate(arguments[0], owner))
        at = int(self._rng.integers(len(items)))
        if self._rng.random() < 0.2:
            changed = self.change(items[at], arguments[min(at, len(arguments) - 1)], owner)
            return (*items[:at], changed, *items[at + 1 :])
        return (
            items[:at] + items[at + 1 :],
            (*items, items[at]),
            (items * int(self._rng.choice(_REPETITIONS)))[:_LARGEST_LIST],
            items[::-1],
        )[self._rng.integers(4)]

    def _change_mapping(self, mapping: Mapping[Any, Any], kind: Any, owner: tuple[str, str]) -> dict[Any, Any]:  # noqa: ANN401
        key_kind, item_kind = get_args(_without_none(kind))
        changed = dict(mapping)
        choice = self._rng.integers(5)
        if choice == 0 or not changed:
            return changed | {self.generate(key_kind, owner): self.generate(item_kind, owner)}
        keys = list(changed)
        key = keys[self._rng.integers(len(keys))]
        item = changed[key]
        if choice == 1:
            del changed[key]
        elif choice == 2:
            del changed[key]
            changed[self.change(key, key_kind, owner)] = item
        elif choice == 3:
            changed[key] = changed[keys[self._rng.integers(len(keys))]]
        else:
            changed[key] = self.change(item, item_kind, owner)
        return changed

    def _change_array(self, array: NDArray[Any], name: str) -> NDArray[Any]:
        changed = array.copy()
        if not changed.size:
            return changed
        at = tuple(int(self._rng.integers(size)) for size in changed.shape)
        if changed.dtype.kind == "b":
            changed[at] = not changed[at]
        elif changed.dtype.kind in "iu":
            limits = np.iinfo(changed.dtype)
            changed[at] = np.clip(self._integer(int(changed[at])), limits.min, limits.max)
        elif name in _COVARIANCES:
            return self._change_covariances(changed)
        elif self._rng.random() < 0.5:
            changed[at] = self._float()
        else:
            changed *= changed.dtype.type(self._rng.choice(_FACTORS))
        return changed

    def _change_covariances(self, matrices: NDArray[Any]) -> NDArray[Any]:
        """Matrices that stay symmetric, and are large, small, without rank or ill-conditioned."""
        size = matrices.shape[-1]
        diagonal = 10.0 ** self._rng.uniform(-15.0, 15.0, size)
        replaced = (
            np.zeros((size, size)),
            np.diag(diagonal),
            np.ones((size, size)) * float(self._rng.choice([1e-300, 1e-6, 1.0, 1e6, 1e15])),
            np.eye(size) * float(self._rng.choice([1e-300, 1e-30, 1e-12, 1e12, 1e15])),
        )[self._rng.integers(4)]
        if matrices.ndim == 3 and self._rng.random() < 0.5:
            matrices[self._rng.integers(len(matrices))] = replaced
        else:
            matrices[...] = replaced
        return matrices

    def _change_scan(self, scan: Scan) -> Scan:
        if self._rng.random() < 0.3:
            return self._scans[self._rng.integers(len(self._scans))]
        name = ("stamp", "ranges", "laser_pose", "motion", "angle_min", "angle_increment", "range_min", "range_max")[
            self._rng.integers(8)
        ]
        value = getattr(scan, name)
        if name == "ranges" and self._rng.random() < 0.5:
            value = value[: self._rng.integers(0, 4)]
        elif isinstance(value, np.ndarray):
            value = self._change_array(value, name)
        else:
            value = self._change_scalar(value)
        return dataclasses.replace(scan, **{name: value})

    def generate(self, kind: Any, owner: tuple[str, str]) -> Any:  # noqa: ANN401  one case a return
        """A value of a type, None where only a value of the map could be."""
        kind = self._choose(kind)
        if kind is Scan:
            return self._scans[self._rng.integers(len(self._scans))]
        if is_record(kind):
            return self._generate_record(kind)
        if get_origin(kind) is np.ndarray:
            return self._generate_array(kind, owner, {})
        if get_origin(kind) is Literal:
            return get_args(kind)[0]
        if kind in (int, float, bool, str):
            return {int: self._integer(), float: self._float(), bool: True, str: "a"}[kind]
        return self._generate_collection(kind, owner)

    def _generate_collection(self, kind: Any, owner: tuple[str, str]) -> Any:  # noqa: ANN401
        origin, arguments = get_origin(kind), get_args(kind)
        if origin is tuple and Ellipsis not in arguments:
            return tuple(self.generate(argument, owner) for argument in arguments)
        count = self._rng.integers(3)
        if origin in (tuple, frozenset):
            return origin(self.generate(arguments[0], owner) for _ in range(count))
        return {self.generate(arguments[0], owner): self.generate(arguments[1], owner) for _ in range(count)}

    def _choose(self, kind: Any) -> Any:  # noqa: ANN401
        """One of the types of a union."""
        if get_origin(kind) not in (Union, types.UnionType):
            return kind
        choices = [argument for argument in get_args(kind) if argument is not type(None)]
        return choices[self._rng.integers(len(choices))]

    def _generate_record(self, kind: type) -> Any:  # noqa: ANN401
        known = self._records.get(kind, [])
        if known and self._rng.random() < 0.5:
            return known[self._rng.integers(len(known))]
        hints, sizes, values = get_type_hints(kind), dict[str, int](), dict[str, Any]()
        for name in field_names(kind):
            hint, own = hints[name], (kind.__name__, name)
            is_absent = type(None) in get_args(hint) and self._rng.random() < 0.6
            if is_absent:
                values[name] = None
            elif get_origin(hint) is np.ndarray:
                values[name] = self._generate_array(hint, own, sizes)
            else:
                values[name] = self.generate(hint, own)
        return kind(**values)

    def _generate_array(self, kind: Any, owner: tuple[str, str], sizes: dict[str, int]) -> NDArray[Any]:  # noqa: ANN401
        dtype = np.dtype(get_args(get_args(kind)[1])[0])
        words = _SHAPES.get(owner[0], {}).get(owner[1], "3 3" if owner[1] in _COVARIANCES else "3").split()
        shape = [int(word) if word.isdigit() else sizes.setdefault(word, int(self._rng.integers(3))) for word in words]
        if dtype.kind == "b":
            return np.asarray(self._rng.random(shape) < 0.5)
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            flat = [np.clip(self._integer(), limits.min, limits.max) for _ in range(int(np.prod(shape)))]
            return np.array(flat, dtype=dtype).reshape(shape)
        if owner[1] in _COVARIANCES:
            return np.broadcast_to(np.eye(shape[-1]) * 10.0 ** self._rng.uniform(-6.0, 2.0), shape).astype(dtype)
        return np.asarray(self._rng.normal(size=shape) * 10.0 ** self._rng.uniform(-2.0, 2.0), dtype=dtype)


def _items(value: tuple[Any, ...] | Mapping[Any, Any]) -> Iterator[tuple[Any, Any]]:
    return iter(value.items()) if isinstance(value, Mapping) else enumerate(value)


def _without_none(kind: Any) -> Any:  # noqa: ANN401
    """The type of an optional value."""
    if get_origin(kind) in (Union, types.UnionType):
        return next(argument for argument in get_args(kind) if argument is not type(None))
    return kind


def _replace_at(value: Any, path: Sequence[Any], changed: Any) -> Any:  # noqa: ANN401
    """A value with another one at a path in it."""
    if not path:
        return changed
    (step, *rest), kind = path, cast(Any, type(value))
    if is_record(kind):
        fields = {name: getattr(value, name) for name in field_names(kind)}
        return kind(**fields | {step: _replace_at(fields[step], rest, changed)})
    if isinstance(value, tuple):
        return (*value[:step], _replace_at(value[step], rest, changed), *value[step + 1 :])
    return dict(value) | {step: _replace_at(value[step], rest, changed)}


def _resize_array(array: NDArray[Any], axis: int, kind: int, factor: int) -> NDArray[Any]:
    """An array that is empty, shorter, longer by one, or many times as long along an axis."""
    if not array.shape[axis]:
        return array
    if kind == 3 and array.size * factor < 2_000_000:
        return np.concatenate([array] * factor, axis=axis)
    last = np.take(array, [-1], axis=axis)
    return (
        np.take(array, [], axis=axis)
        if kind == 0
        else np.delete(array, -1, axis=axis)
        if kind == 1
        else np.concatenate([array, last], axis=axis)
    )


MAP, STATE = frozenset({"map"}), frozenset({*PARTS, "chain"})
"""Documents of the map for other programs, and of the state to continue from."""


def tamper_with_map(target: Path, rng: np.random.Generator, changed: frozenset[str]) -> None:
    """Change one to three values of the map in a folder, and write it again with right checksums.

    :param changed: names of the documents with these values.
    """
    reader = FolderReader(target, FORMAT, VERSION)
    documents: dict[str, Any] = {name: reader.read(name, kind) for name, kind in _KINDS.items()}
    for _ in range(rng.integers(1, 4)):
        tamperer = _Tamperer(documents, changed, rng)
        tamperer.tamper()
        documents = tamperer.documents
    configuration = (target / CONFIGURATION).read_text(encoding="utf-8")
    writer = FolderWriter(target)
    for name in _KINDS:
        writer.write(name, documents[name])
    writer.write_text(CONFIGURATION, configuration)
    writer.finish(FORMAT, VERSION)
