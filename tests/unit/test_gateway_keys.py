"""The gateway's key: made once, for its user alone; what the loop goes by is what root has installed, where that is."""

import os

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.cli.doctor_keys import gateway_key as checked
from gateway.mailbox.keys import FOLDER, PRIVATE, PUBLIC, KeyUnusable, private_key, public_bytes, public_key
from gateway.supervisor.gateway_key import gateway_key
from tests.closed_loop.conftest import demo_line

LINE = demo_line(1)
NAME = LINE.site, LINE.line
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can install a key")


def test_a_key_is_made_once_and_is_its_users_alone(tmp_path):
    assert public_key(*NAME, tmp_path, tmp_path / "etc") is None
    key = private_key(tmp_path)
    path = tmp_path / FOLDER / PRIVATE
    assert path.stat().st_mode & 0o777 == 0o600 and path.parent.stat().st_mode & 0o777 == 0o700
    assert public_bytes(private_key(tmp_path)) == public_bytes(key)
    known = public_key(*NAME, tmp_path, tmp_path / "etc")
    assert known.key.public_bytes_raw() == public_bytes(key) and known.path == tmp_path / FOLDER / PUBLIC
    assert sorted(one.name for one in path.parent.iterdir()) == [PRIVATE, PUBLIC]  # nothing is left beside


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.chmod(0o640), "others may read or write it"),
        (lambda path: path.write_text("nonsense\n"), "is no key"),
        (lambda path: path.write_text("ab" * 31 + "\n"), "is no key"),
        (lambda path: (path.unlink(), path.mkdir()), "is not used: it is no file"),
        (lambda path: (path.unlink(), os.mkfifo(path, 0o600)), "is not used: it is no file"),
    ],
)
def test_a_key_that_is_none_or_that_others_can_read_is_not_used_and_not_replaced(tmp_path, spoil, words):
    private_key(tmp_path)
    path = tmp_path / FOLDER / PRIVATE
    spoil(path)
    with pytest.raises(KeyUnusable, match=words):
        private_key(tmp_path)
    key, found = gateway_key(*NAME, tmp_path)  # the gateway runs, and says so; the loop takes nothing by its key
    assert found.code == "gateway-key-unusable" and isinstance(key, Ed25519PrivateKey)
    assert checked(LINE, tmp_path, tmp_path / "etc").verdict == "FAIL"


def test_a_pipe_in_place_of_the_public_key_is_replaced_and_nobody_waits_for_it(tmp_path):
    key = private_key(tmp_path)
    path = tmp_path / FOLDER / PUBLIC
    path.unlink()
    os.mkfifo(path, 0o644)
    with pytest.raises(KeyUnusable, match="it is no file"):
        public_key(*NAME, tmp_path, tmp_path / "etc")
    private_key(tmp_path)
    assert public_key(*NAME, tmp_path, tmp_path / "etc").key.public_bytes_raw() == public_bytes(key)


@needs_root
def test_what_root_has_installed_goes_first_and_is_never_passed_over(tmp_path):
    key = private_key(tmp_path)
    installed = tmp_path / "etc"
    installed.mkdir()
    file = installed / f"{LINE.site}_{LINE.line}.pub"
    other = Ed25519PrivateKey.generate()
    file.write_text(public_bytes(other).hex() + "\n")
    assert public_key(*NAME, tmp_path, installed).key.public_bytes_raw() == public_bytes(other)
    assert checked(LINE, tmp_path, installed).verdict == "FAIL"  # it is not this gateway's
    file.write_text(public_bytes(key).hex() + "\n")
    assert checked(LINE, tmp_path, installed).verdict == "OK"
    for spoil in (lambda: file.chmod(0o666), lambda: (file.chmod(0o644), os.chown(file, 65534, 65534))):
        spoil()
        with pytest.raises(KeyUnusable, match="is not used"):
            public_key(*NAME, tmp_path, installed)


def test_doctor_says_what_a_key_of_one_user_is_worth(tmp_path):
    assert checked(LINE, tmp_path, tmp_path / "etc").verdict == "skipped"
    private_key(tmp_path)
    check = checked(LINE, tmp_path, tmp_path / "etc")
    assert check.verdict == "warning" and "as root" in check.todo


@needs_root
def test_the_key_that_is_installed_for_one_line_is_taken_by_no_other(tmp_path):
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "north-mill_two.pub").write_text(public_bytes(Ed25519PrivateKey.generate()).hex() + "\n")
    assert public_key("north-mill", "two", tmp_path, tmp_path / "etc") is not None
    assert public_key("north", "mill-two", tmp_path, tmp_path / "etc") is None
