"""The sqlite3 files of bags: their schema, pages and values are checked before a library reads them.

A database is a program as well as data: views, generated columns and checks are computed while it is read, pages may
lead to each other, and a number may stand where the bytes of a message belong. See rosbag2_storage_sqlite3 for the
tables.
"""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.channels import MAX_CHANNELS, ChannelCheck
from hmt_slam_ros.logs.unpacking import DamageError
from hmt_slam_ros.untrusted_input import open_regular, shorten

_MAX_VALUE = 256_000_000
"""Bytes of a value, such as a message."""

_COMPUTED = re.compile(r"\b(AS|CHECK|GENERATED|SELECT|VIRTUAL|WHERE|WITH)\b", re.IGNORECASE)
"""Words of a table or index that computes something."""

_TYPES = (
    ("topics", ("typeof(id) != 'integer'", "typeof(name) != 'text'", "typeof(type) != 'text'")),
    ("messages", ("typeof(topic_id) != 'integer'", "typeof(timestamp) != 'integer'", "typeof(data) != 'blob'")),
)
"""(table, what none of its rows may be)."""


def check_sqlite(path: Path) -> None:
    """Check schema, pages and types of a database, so that a library may read it.

    :raises HmtSlamError: where something in it is computed, damaged or of another type than in a bag.
    """
    with open_regular(path):
        pass
    if set(str(path)) & set("?#%"):
        raise HmtSlamError(f"{shorten(path)} has a mark of an address in its name: rename it without '?', '#' and '%'.")
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)) as base:
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_VALUE)
            _check(base)
    except (sqlite3.Error, DamageError, OverflowError, UnicodeDecodeError) as fault:
        raise HmtSlamError(f"{path} is truncated or damaged ({shorten(fault)}): copy or record it anew.") from fault


def _check(base: sqlite3.Connection) -> None:
    base.execute("PRAGMA trusted_schema = OFF")
    base.execute("PRAGMA ignore_check_constraints = ON")
    _check_schema(base)
    (answer,) = base.execute("PRAGMA quick_check(1)").fetchone()
    if answer != "ok":
        raise DamageError(answer)
    _check_topics(base)
    for table, faults in _TYPES:
        found = base.execute(f"SELECT 1 FROM {table} WHERE {' OR '.join(faults)} LIMIT 1").fetchone()  # noqa: S608  constants
        if found is not None:
            raise DamageError(f"a row of its table {table} has a value of another type than in a bag")


def _check_schema(base: sqlite3.Connection) -> None:
    for kind, name, text in base.execute("SELECT type, name, sql FROM sqlite_master LIMIT 100"):
        plain = kind == "table" or (kind == "index" and (text is None or text.count("(") == 1))
        if not plain or (text is not None and _COMPUTED.search(text)):
            raise DamageError(f"its {shorten(str(kind))} {shorten(str(name))} is none of a bag")


def _check_topics(base: sqlite3.Connection) -> None:
    (topics, ids) = base.execute("SELECT count(*), count(DISTINCT id) FROM topics").fetchone()
    if topics > MAX_CHANNELS or topics != ids:
        raise DamageError(f"it has {topics} topics with {ids} numbers")
    if _has(base, "message_definitions"):
        (types,) = base.execute("SELECT count(*) FROM message_definitions").fetchone()
        if types > MAX_CHANNELS:
            raise DamageError(f"it has {types} types of messages")
    if any(column[1] == "offered_qos_profiles" for column in base.execute("PRAGMA table_info(topics)")):
        check = ChannelCheck()
        for topic, text in base.execute("SELECT name, offered_qos_profiles FROM topics"):
            check.add(shorten(str(topic)), text if isinstance(text, str) else "")


def _has(base: sqlite3.Connection, table: str) -> bool:
    return base.execute("SELECT 1 FROM sqlite_master WHERE name = ?", (table,)).fetchone() is not None
