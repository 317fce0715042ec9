"""What is fuzzed: for each reader a seed, its mutations, and the commands that read the result."""

from __future__ import annotations

import gzip
import hashlib
import json
import lzma
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from rosbags.rosbag2 import Reader, Writer

from benchmark.fuzz.mutations import Mutation, mutate_bytes, mutate_json, mutate_lines
from benchmark.fuzz.node_loading import LOAD_IN_NODES
from benchmark.fuzz.seeds import MAP_SEEDS
from benchmark.fuzz.tampering import MAP, STATE, tamper_with_map
from hmt_slam_ros.logs.ros_types import typestore
from hmt_slam_ros.saved_map.folder import MANIFEST, _manifest_digest

Prepare = Callable[[Path, np.random.Generator], None]
"""Mutates what lies in a folder."""

SHORT = ("--set", "filter.particles=2", "--duration", "4")


@dataclass(frozen=True)
class FuzzCase:
    """A reader that is fuzzed.

    :ivar name: of the case.
    :ivar seed: folder, a copy of which is mutated.
    :ivar mutate: what mutates the copy.
    :ivar commands: arguments of `node_loading.run_arguments`; ``{}`` stands for the copy.
    """

    name: str
    seed: Path
    mutate: Prepare
    commands: tuple[tuple[str, ...], ...]

    def arguments(self, folder: Path, rng: np.random.Generator) -> list[str]:
        """Those of one of the commands."""
        command = self.commands[int(rng.integers(len(self.commands)))]
        return [word.replace("{}", str(folder)) for word in command]


def _file(name: str, mutation: Mutation) -> Prepare:
    def prepare(folder: Path, rng: np.random.Generator) -> None:
        path = folder / name
        path.write_bytes(mutation(path.read_bytes(), rng))

    return prepare


def _any_file(names: Sequence[str], mutations: Sequence[Mutation]) -> Prepare:
    def prepare(folder: Path, rng: np.random.Generator) -> None:
        _file(names[int(rng.integers(len(names)))], mutations[int(rng.integers(len(mutations)))])(folder, rng)

    return prepare


def _compress(content: bytes, rng: np.random.Generator, mutation: Mutation) -> bytes:
    changed = mutation(content, rng)
    packed = gzip.compress(changed, 1) if rng.random() < 0.5 else lzma.compress(changed, preset=0)
    return packed if rng.random() < 0.5 else mutate_bytes(packed, rng)


def _bag_messages(folder: Path, rng: np.random.Generator) -> None:
    """Write the bag again with some messages mutated, as a faulty driver would have recorded them."""
    source, target = folder / "bag", folder / "mutated"
    share = 10 ** rng.uniform(-2.0, 0.0)
    with Reader(source) as reader, Writer(target, version=9) as writer:
        connections = {
            one.id: writer.add_connection(one.topic, one.msgtype, typestore=typestore()) for one in reader.connections
        }
        chosen = {one.topic for one in reader.connections if rng.random() < 0.4}
        for connection, stamp, content in reader.messages():
            data = bytes(content)
            if connection.topic in chosen and rng.random() < share:
                data = mutate_cdr(data, rng)
            writer.write(connections[connection.id], stamp, data)
    shutil.rmtree(source)
    target.rename(source)


_FLOATS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 1e-30, 0.0, -1.0, 3e38)


def mutate_cdr(content: bytes, rng: np.random.Generator) -> bytes:
    """Put special numbers into a message where numbers lie, or mutate its bytes."""
    if rng.random() < 0.3:
        return content[:4] + mutate_bytes(content[4:], rng)
    changed = bytearray(content)
    size = 8 if rng.random() < 0.6 else 4
    for _ in range(rng.integers(1, 5)):
        at = 4 + size * int(rng.integers(0, max((len(changed) - 4) // size, 1)))
        value = np.array(_FLOATS[rng.integers(len(_FLOATS))])
        with np.errstate(over="ignore"):
            changed[at : at + size] = value.astype("<f8" if size == 8 else "<f4").tobytes()
    return bytes(changed)


def _saved_map(folder: Path, rng: np.random.Generator) -> None:
    """Mutate a document or an array of a map, and set its checksums right."""
    target = folder / "out" / "hmt_map"
    names = sorted(path.name for path in target.iterdir() if path.name != MANIFEST)
    name = names[rng.integers(len(names))]
    if name.endswith(".json"):
        _file(name, mutate_json if rng.random() < 0.85 else mutate_bytes)(target, rng)
    elif name.endswith(".yaml"):
        _file(name, mutate_lines)(target, rng)
    else:
        _file(name, _special_floats if rng.random() < 0.7 else mutate_bytes)(target, rng)
    correct_checksums(target)


def _special_floats(content: bytes, rng: np.random.Generator) -> bytes:
    return mutate_cdr(content, rng) if len(content) > 16 else mutate_bytes(content, rng)


def correct_checksums(target: Path) -> None:
    """Set the manifest of a folder right for the files as they are."""
    path = target / MANIFEST
    manifest = json.loads(path.read_text(encoding="utf-8"))
    for name, entry in manifest["files"].items():
        content = (target / name).read_bytes()
        entry["bytes"], entry["sha256"] = len(content), hashlib.sha256(content).hexdigest()
    manifest["sha256"] = _manifest_digest(manifest)
    path.write_text(json.dumps(manifest), encoding="utf-8")


def _damaged_map(folder: Path, rng: np.random.Generator) -> None:
    target = folder / "out" / "hmt_map"
    names = sorted(path.name for path in target.iterdir())
    _file(names[rng.integers(len(names))], mutate_bytes)(target, rng)


_YAML = (
    "a: &a [x,x,x,x,x,x,x,x]\n"
    + "".join(f"{new}: &{new} [{','.join([f'*{old}'] * 8)}]\n" for old, new in zip("abcdefg", "bcdefgh", strict=True)),
    "&a [*a]",
    "&a {a: *a}",
    "[" * 5000,
    "{a: " * 3000,
    "mode: 2001-99-99",
    "seed: 1" + "0" * 400,
    "seed: 0x" + "f" * 6000,
    "? [a, b]\n: c",
    "? {a: b}\n: c",
    "a: !!python/object/apply:os.system [ls]",
    "a: !!binary '*'",
    "a: !!timestamp x",
    "<<: 1",
    "<<: [1, 2]",
    "a: 1\n<<: {a: 2}",
    "seed: 1:99:99",
    "\x00",
    "--- a\n--- b",
    "%YAML 9.9\n---\na",
    "\ufeffseed: 1",
    "a: |\n",
    "seed: .nan",
    "seed: " + "_" * 100,
)


def _yaml_text(name: str) -> Prepare:
    def prepare(folder: Path, rng: np.random.Generator) -> None:
        path = folder / name
        if rng.random() < 0.4:
            path.write_text(_YAML[rng.integers(len(_YAML))], encoding="utf-8")
        elif rng.random() < 0.5:
            document = yaml.safe_load(path.read_text(encoding="utf-8"))
            path.write_bytes(mutate_json(json.dumps(document).encode(), rng))
        else:
            _file(name, (mutate_lines, mutate_bytes)[rng.integers(2)])(folder, rng)

    return prepare


def reader_cases(seeds: Path) -> Iterator[FuzzCase]:
    """The readers of logs, results and settings.

    :param seeds: folder of the seeds, as `write_seeds` makes it.
    """
    for name, file, mutations in (
        ("carmen", "log.clf", (mutate_lines, mutate_lines, mutate_bytes)),
        ("rawlog", "log.rawlog", (mutate_bytes,)),
        ("packed carmen", "log.clf", (partial(_compress, mutation=mutate_lines),)),
    ):
        yield FuzzCase(name, seeds / "logs", _any_file([file], mutations), _log_commands(f"{{}}/{file}"))
    bag = "bag/bag.mcap"
    yield FuzzCase("mcap file", seeds / "mcap", _any_file([bag], [mutate_bytes]), _log_commands("{}/bag"))
    yield FuzzCase("sqlite file", seeds / "sqlite", _any_file(["bag/bag.db3"], [mutate_bytes]), _log_commands("{}/bag"))
    yield FuzzCase("bag messages", seeds / "sqlite", _bag_messages, _log_commands("{}/bag"))
    metadata = _any_file(["bag/metadata.yaml"], [mutate_lines, mutate_bytes])
    yield FuzzCase("metadata", seeds / "sqlite", metadata, _log_commands("{}/bag"))
    results = ("report.json", "pmf.csv", "cost.csv", "trajectory.tum", "map.pgm", "map.yaml")
    names = [f"out/{name}" for name in results]
    plots = (("plot", "{}/out"), ("export", "{}/out"), ("export", "{}/out", "--grid", "{}/grid"))
    relations = ("evaluate", "{}/out", "--relations", "{}/relations")
    yield FuzzCase("results", seeds / "map", _any_file(names, [mutate_lines, mutate_bytes]), (*plots, relations))
    report = _any_file(["out/report.json"], [mutate_json])
    yield FuzzCase("report", seeds / "map", report, plots)
    yield FuzzCase("relations", seeds / "map", _any_file(["relations"], [mutate_lines, mutate_bytes]), (relations,))


def yaml_cases(seeds: Path) -> Iterator[FuzzCase]:
    """Files of parameters and of worlds."""
    yield FuzzCase(
        "parameters", seeds / "logs", _yaml_text("config.yaml"), (("parameters", "--config", "{}/config.yaml"),)
    )
    simulate = ("simulate", "{}/world.yaml", "--out", "{}/simulated", "--duration", "2")
    yield FuzzCase("world", seeds / "logs", _yaml_text("world.yaml"), (simulate,))


def _log_commands(log: str) -> tuple[tuple[str, ...], ...]:
    return (
        ("convert", log, "{}/converted"),
        ("doctor", log),
        ("map", log, "--out", "{}/mapped", *SHORT),
    )


def map_cases(seeds: Path) -> Iterator[FuzzCase]:
    """Saved maps: damaged, and tampered with behind right checksums."""
    go_on = ("map", "{}/log.clf", "--from", "{}/out", "--out", "{}/mapped")
    states = (
        go_on,
        (*go_on, "--mode", "lifelong"),
        ("map", "{}/log.clf", "--from", "{}/out/hmt_map", "--mode", "localization", "--out", "{}/mapped"),
        (LOAD_IN_NODES, "{}/out"),
    )
    maps = (
        ("export", "{}/out"),
        ("export", "{}/out", "--grid", "{}/grid"),
        ("export", "{}/out", "--grid", "{}/grid", "--area", "0"),
        ("plot", "{}/out"),
        ("evaluate", "{}/out", "--relations", "{}/relations", "--odometry", "{}/log.clf"),
        (LOAD_IN_NODES, "{}/out"),
    )
    yield FuzzCase("damaged map", seeds / "map", _damaged_map, (*states, *maps))
    for seed in MAP_SEEDS:
        yield FuzzCase(f"mutated file, {seed}", seeds / seed, _saved_map, (*states, *maps))
        yield FuzzCase(f"tampered state, {seed}", seeds / seed, _tampered_map(STATE), states)
        yield FuzzCase(f"tampered map, {seed}", seeds / seed, _tampered_map(MAP), maps)


def _tampered_map(documents: frozenset[str]) -> Prepare:
    def prepare(folder: Path, rng: np.random.Generator) -> None:
        tamper_with_map(folder / "out" / "hmt_map", rng, documents)

    return prepare
