"""What the services of slam do with folders: nothing of others is replaced, and what is no map is refused at once."""

import asyncio
import errno
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from std_srvs.srv import Trigger

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.map_services import MapLoader, MapSaver, _PendingSave, check_map_is_replaceable
from hmt_slam_ros.saved_map.folder import FORMAT, MANIFEST, VERSION, FolderWriter


def write_map(folder, kind=FORMAT):
    writer = FolderWriter(folder)
    writer.write_text("configuration.yaml", "")
    writer.finish(kind, VERSION)
    return folder


def test_nothing_and_a_map_can_be_replaced(tmp_path):
    check_map_is_replaceable(tmp_path / "none")
    check_map_is_replaceable(write_map(tmp_path / "map"))


@pytest.mark.parametrize("name", ["notes.txt", ".git/HEAD", "scans.json.bak"])
def test_a_map_with_a_file_of_others_is_not_replaced(tmp_path, name):
    foreign = write_map(tmp_path / "map") / name
    foreign.parent.mkdir(exist_ok=True)
    foreign.write_text("precious")
    first = tmp_path / "map" / name.split("/", maxsplit=1)[0]
    with pytest.raises(
        HmtSlamError, match=f"something else than a map stands there, {first} is none of its files: set"
    ):
        check_map_is_replaceable(tmp_path / "map")


@pytest.mark.parametrize(
    "content", ['{"name": "web app", "icons": []}', "[]", "", '{"format": "hmt_map"}', "[" * 10_000]
)
def test_a_folder_with_some_manifest_is_not_replaced(tmp_path, content):
    (tmp_path / MANIFEST).write_text(content)
    with pytest.raises(HmtSlamError, match=r"manifest\.json is none of its files"):
        check_map_is_replaceable(tmp_path)


def test_a_file_a_link_and_the_folder_of_another_format_are_not_replaced(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(write_map(tmp_path / "map"))
    (tmp_path / "broken").symlink_to(tmp_path / "none")
    write_map(tmp_path / "checkpoint", "hmt_checkpoint")
    for name in ("file", "link", "broken", "checkpoint"):
        with pytest.raises(HmtSlamError, match="something else than a map stands there"):
            check_map_is_replaceable(tmp_path / name)


def refusal(load_from):
    """The sentence by which the service refuses to load a map."""
    loader = MapLoader.__new__(MapLoader)
    loader._node = SimpleNamespace(
        is_busy=False, configuration=Configuration(), get_parameter=lambda _: SimpleNamespace(value=str(load_from))
    )
    response = asyncio.run(loader._load(Trigger.Request(), Trigger.Response()))
    assert not response.success
    return response.message


@pytest.mark.parametrize("name", ["", "n" * 5000, "n/" * 3000, "a\nb", "a\0b", "/proc/self/mem", "/dev/zero"])
def test_what_is_no_folder_cannot_be_loaded(name):
    sentence = refusal(name)
    assert sentence.startswith("there is no folder ")
    assert sentence.endswith(": set load_from of slam to an output folder or hmt_map")
    assert len(sentence) < 200


def as_pipe(path):
    os.mkfifo(path)


def as_endless(path):
    path.symlink_to("/dev/zero")


def as_deep(path):
    path.write_text("[" * 100_000)


def as_large_number(path):
    path.write_text(json.dumps({"format": FORMAT, "version": 10**400}))


@pytest.mark.parametrize("make", [as_pipe, as_endless, as_deep, as_large_number])
def test_a_folder_whose_manifest_is_none_is_refused_at_once(tmp_path, make):
    make(tmp_path / MANIFEST)
    sentence = refusal(tmp_path)
    assert sentence.startswith(f"{tmp_path} is not loaded: ")
    assert len(sentence) < 500


def test_a_save_that_cannot_begin_leaves_no_temporary_folder(tmp_path, monkeypatch):
    def mkdir(path, *arguments, **options):
        if path.name == "new":
            raise OSError(errno.ENOSPC, "No space left on device")
        return make(path, *arguments, **options)

    make = Path.mkdir
    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(OSError, match="No space left"):
        _PendingSave.begin(tmp_path / "hmt_map")
    assert list(tmp_path.iterdir()) == []


def test_a_loaded_map_that_cannot_be_copied_is_reported_with_the_reason(tmp_path, monkeypatch):
    """In localization a save copies the loaded map; here a file of it became unreadable."""
    loaded = tmp_path / "loaded"
    loaded.mkdir()
    (loaded / "map.json").write_text("{}")
    monkeypatch.setattr(shutil, "copyfile", fail_to_copy)
    node = SimpleNamespace(unchanged_map_folder=loaded, configuration=Configuration())
    saver = MapSaver.__new__(MapSaver)
    saver._node, saver._responses, saver._target = node, {}, tmp_path / "hmt_map"
    saver._pending_save = _PendingSave.begin(saver._target)
    with pytest.raises(HmtSlamError, match=r"hmt_map cannot be saved: Input/output error; the map of before stays"):
        saver._finish()


def fail_to_copy(source, target):
    raise OSError(errno.EIO, "Input/output error", str(source))
