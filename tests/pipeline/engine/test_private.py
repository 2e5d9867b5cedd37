"""What is executed comes from a folder that only this user can write."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

import pytest

from rille.pipeline.engine.runtime import private
from rille.pipeline.engine.runtime.private import private_folder


@pytest.fixture
def base(tmp_path, monkeypatch):
    """``XDG_CACHE_HOME``, with the temporary folder beside it; choices are forgotten before and after."""
    folder, temporary = tmp_path / "base", tmp_path / "temporary"
    folder.mkdir(mode=0o700)
    temporary.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    private_folder.cache_clear()
    yield folder
    private_folder.cache_clear()


def test_it_is_made_for_the_user_alone(base):
    assert private_folder() == base / "rille"
    assert (base / "rille").stat().st_mode & 0o777 == 0o700


def test_home_is_used_where_no_place_is_named(base, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(base))
    assert private_folder() == base / ".cache" / "rille"


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_can_write_is_not_used(base, mode):
    (base / "rille").mkdir()
    (base / "rille").chmod(mode)
    assert private_folder() == Path(tempfile.gettempdir()) / f"rille-{os.geteuid()}"


def test_a_parent_in_which_others_could_replace_it_is_not_used(base):
    base.chmod(0o777)
    assert private_folder().parent == Path(tempfile.gettempdir())
    private_folder.cache_clear()
    base.chmod(0o1777)
    assert private_folder() == base / "rille", "in a sticky folder nobody else can rename it"


def test_a_parent_of_another_user_is_not_used(base, monkeypatch):
    real = Path.stat

    def stat(path, **how):
        found = real(path, **how)
        return os.stat_result((*found[:4], os.geteuid() + 1, *found[5:])) if path == base else found

    monkeypatch.setattr(Path, "stat", stat)
    assert private_folder().parent == Path(tempfile.gettempdir())


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC])
def test_a_folder_on_a_disk_that_takes_nothing_is_not_used(base, monkeypatch, number):
    real = tempfile.TemporaryFile

    def file(dir):
        made = real(dir=dir)
        if base in dir.parents:
            made.write = lambda _: (_ for _ in ()).throw(OSError(number, os.strerror(number)))
        return made

    monkeypatch.setattr(private.tempfile, "TemporaryFile", file)
    assert private_folder().parent == Path(tempfile.gettempdir())


def test_a_relative_place_counts_as_none(base, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert private_folder().parent == Path(tempfile.gettempdir())
    assert not Path("relative").exists()


def test_a_link_is_not_followed(base, tmp_path):
    (tmp_path / "theirs").mkdir(mode=0o700)
    (base / "rille").symlink_to(tmp_path / "theirs")
    assert private_folder().parent == Path(tempfile.gettempdir())


def test_another_users_folder_is_not_used(base, monkeypatch):
    me = os.geteuid()
    (base / "rille").mkdir(mode=0o700)
    monkeypatch.setattr(private.os, "geteuid", lambda: me + 1)
    found = private_folder()
    assert found.parent == Path(tempfile.gettempdir())
    assert found.name != f"rille-{me + 1}", "a planted one in the temporary folder neither"
