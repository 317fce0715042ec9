"""Commands through the live page: what is one, and who may give it."""

import json
import re
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.commands import TOKEN_HEADER, Commands, PageCommand, parse_command
from hmt_slam_ros.view.server import PageServer


@pytest.mark.parametrize(
    ("content", "command"),
    [
        ({"kind": "save"}, PageCommand("save")),
        ({"kind": "pause", "pose": "ignored"}, PageCommand("pause")),
        ({"kind": "initial_pose", "pose": [1, 2.5, -0.5]}, PageCommand("initial_pose", (1.0, 2.5, -0.5))),
        ({"kind": "goal", "pose": [1, 2.5, -0.5]}, PageCommand("goal", (1.0, 2.5, -0.5))),
        ({"kind": "statement", "statement": "same 3 56"}, PageCommand("statement", statement="same 3 56")),
    ],
)
def test_a_command_is_read(content, command):
    assert parse_command(json.dumps(content)) == command


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("no", "a command is no JSON"),
        ("[]", "kind = None is no command: give one of save, pause"),
        ('{"kind":"shutdown"}', "kind = shutdown is no command"),
        ('{"kind":["save"]}', "is no command"),
        ('{"kind":"goal"}', "pose = None is none: give x and y in m"),
        ('{"kind":"goal","pose":[1,2]}', "pose = "),
        ('{"kind":"goal","pose":[1,2,true]}', "pose = "),
        ('{"kind":"goal","pose":[1,2,1e9]}', "pose = "),
        ('{"kind":"statement"}', "'None' is no statement about two areas"),
        ('{"kind":"statement","statement":"same 3"}', "'same 3' is no statement about two areas"),
    ],
)
def test_what_is_no_command_gets_a_sentence(text, sentence):
    with pytest.raises(HmtSlamError, match=re.escape(sentence)):
        parse_command(text)


def test_few_commands_wait():
    commands = Commands(is_allowed=True)
    for _ in range(8):
        commands.put(PageCommand("save"))
    with pytest.raises(HmtSlamError, match="8 commands wait already"):
        commands.put(PageCommand("save"))
    assert len(commands.take()) == 8
    assert commands.take() == []


def post(url, content, **headers):
    """Status and text of the answer."""
    known = {"Content-Type": "application/json", "Origin": url.rstrip("/"), **headers}
    request = Request(url + "command", data=content, headers={k: v for k, v in known.items() if v is not None})
    try:
        with urlopen(request, timeout=10) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


@pytest.fixture
def serve():
    servers = []

    def serve(commands):
        servers.append(PageServer(Board(), "127.0.0.1", 0, commands=commands))
        return servers[-1].url

    yield serve
    for server in servers:
        server.close()


def test_a_page_that_only_shows_takes_no_command(serve):
    for commands in (None, Commands()):
        status, text = post(serve(commands), b'{"kind":"save"}', **{TOKEN_HEADER: ""})
        assert (status, text) == (403, "this page only shows: start view with -p controls:=true for buttons")


def test_a_command_needs_the_token_and_comes_from_the_page_itself(serve):
    commands = Commands(is_allowed=True)
    url, save = serve(commands), b'{"kind":"save"}'
    token = {TOKEN_HEADER: commands.token}
    assert len(commands.token) > 20
    for headers, sentence in (
        ({}, "the token is missing or wrong"),
        ({TOKEN_HEADER: "guess"}, "the token is missing or wrong"),
        ({TOKEN_HEADER: "\xe9"}, "the token is missing or wrong"),
        (token | {"Origin": "http://evil.example"}, "not served to other sites"),
        (token | {"Origin": None}, "the request has no Origin"),
        (token | {"Host": "evil.example"}, "not served under this host name"),
    ):
        status, text = post(url, save, **headers)
        assert status == 403, headers
        assert sentence in text
    assert commands.take() == []
    assert post(url, save, **token) == (202, "{}")
    assert commands.take() == [PageCommand("save")]


def test_a_bad_request_gets_a_sentence(serve):
    commands = Commands(is_allowed=True)
    url, token = serve(commands), {TOKEN_HEADER: commands.token}
    assert post(url, b"{}", **token | {"Content-Type": "text/plain"})[0] == 400
    assert post(url, b" " * 1001, **token) == (400, "a command has 1 to 1000 bytes: give its Content-Length")
    assert post(url, b"\xff", **token)[0] == 400
    for path, sentence in (
        ("walls.json?after=x", "after = x is no whole number"),
        ("past.json?event=-1", "event = "),
    ):
        with pytest.raises(HTTPError) as error:
            urlopen(url + path, timeout=10)
        assert error.value.code == 400
        assert sentence in error.value.read().decode()
