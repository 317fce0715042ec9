"""Every message that the package prints has its entry in docs/guides/troubleshooting.md, and every entry a message.

A message is what an `HmtSlamError` or `Notice` is made with, what a node warns of, and every sentence with a remedy
behind a colon or semicolon that a function returns or keeps. Values in it are written as …, in the document too.
"""

import ast
import re
from functools import cache
from pathlib import Path

import hmt_slam_ros

PACKAGE = Path(hmt_slam_ros.__file__).parent
DOCUMENT = PACKAGE.parent / "docs" / "guides" / "troubleshooting.md"
SAID_BY = {
    "HmtSlamError",
    "DocumentVersionError",
    "GoalError",
    "Notice",
    "_notice",
    "warn",
    "warning",
    "fail",
    "_end",
    "_fail_task",
}
# What these return or keep is findings, results, pictures and documents.
OTHER = {"doctor", "view", "cli", "evaluation", "plots.py", "documents.py", "doctor_node.py"}
FEWEST_WORDS, FEWEST_WORDS_KEPT = 4, 7
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


def wording(node):
    """The text of a literal with its values as ellipses, None for what is no literal."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else ELLIPSIS for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mod):
        return wording(node.left)
    return None


def call_sentences(tree):
    """Of calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in SAID_BY:
            texts = [wording(argument) for argument in (*node.args, *(word.value for word in node.keywords))]
            yield max((text for text in texts if text), key=len, default="")


def stored_sentences(tree):
    """Of returned values and assignments, if there is a remedy in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Return | ast.Assign) and node.value is not None:
            for value in node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]:
                text = wording(value) or ""
                if re.search(r"[:;] [a-z]", text) and len(text.split()) >= FEWEST_WORDS_KEPT:
                    yield text


@cache
def messages():
    found = set()
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {text for text in call_sentences(tree) if len(text.split()) >= FEWEST_WORDS}
        if not OTHER & set(path.relative_to(PACKAGE).parts):
            found |= set(stored_sentences(tree))
    return sorted(found)


@cache
def entries():
    text = re.sub(r"\s+", " ", DOCUMENT.read_text(encoding="utf-8"))
    return sorted(set(re.findall(r"\*\*`(.+?)`\*\*", text)))


def fits(entry, message):
    """Whether the pieces of an entry occur in a message, in their order."""
    return re.search(".*?".join(map(re.escape, entry.split(ELLIPSIS))), message) is not None


def test_messages_are_found():
    assert len(messages()) > 120
    assert any(message.startswith("too few subscribers of") for message in messages())


def test_every_message_has_an_entry():
    known = entries()
    missing = [message for message in messages() if not any(fits(entry, message) for entry in known)]
    assert missing == [], "write entries in docs/guides/troubleshooting.md"


def test_every_entry_has_a_message():
    call_sentences = messages()
    stale = [entry for entry in entries() if not any(fits(entry, message) for message in call_sentences)]
    assert stale == [], "nothing says so any more: take the entries away"
