"""Users: who may come in, how little the file tells, and what is refused."""

import os
import pty
import sys
from pathlib import Path
from threading import Thread

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.core.line_template import line_template
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.operator.users import Users, UsersFile, UsersRefused, change, why_weak

GOOD = "vier warme Walzen"


@pytest.fixture(scope="module")
def anna() -> Users:
    return Users.nobody().with_user("anna", GOOD, "operator")


def test_who_proves_to_be_somebody_has_their_role_and_nobody_else_has_one(anna: Users) -> None:
    assert anna.check("anna", GOOD) == "operator"
    assert anna.check("anna", GOOD + " ") is None
    assert anna.check("Anna", GOOD) is None
    assert anna.check("bert", GOOD) is None
    assert anna.check("", "") is None
    assert anna.check("anna", "x" * 1_000_000) is None
    assert Users.nobody().check("anna", GOOD) is None


def test_letters_typed_as_one_or_as_two_characters_are_the_same() -> None:
    users = Users.nobody().with_user("jörg".replace("ö", "o"), "größere Spannung", "viewer")
    assert users.check("jorg", "gro\u0308ßere Spannung") == "viewer"
    assert users.check("jorg", "\ud800" * 12) is None  # what is no text at all


def test_a_name_that_nobody_has_costs_the_same_hash(anna: Users, monkeypatch: pytest.MonkeyPatch) -> None:
    import hashlib

    asked: list[tuple[int, int]] = []
    right = hashlib.scrypt

    def counted(password: bytes, **how: object) -> bytes:
        asked.append((how["n"], how["r"]))  # type: ignore[arg-type]
        return right(password, **how)  # type: ignore[arg-type]

    monkeypatch.setattr(hashlib, "scrypt", counted)
    for name in ("anna", "bert"):
        anna.check(name, "something else")
    assert len(asked) == 2 and asked[0] == asked[1]


def test_written_for_its_owner_only_read_back_and_without_the_password(anna: Users, tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    anna.with_user("bert", "noch ein Satz dazu", "engineer").write(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert GOOD not in path.read_text() and [one.name for one in tmp_path.iterdir()] == ["users.toml"]
    read = Users.read(path)
    assert [tuple(one) for one in read.entries()] == [("anna", "operator"), ("bert", "engineer")]
    assert read.check("anna", GOOD) == "operator" and read.check("bert", GOOD) is None


def test_the_same_password_of_two_is_not_seen_as_the_same(anna: Users, tmp_path: Path) -> None:
    anna.with_user("bert", GOOD, "viewer").write(tmp_path / "users.toml")
    lines = [line for line in (tmp_path / "users.toml").read_text().splitlines() if "=" in line][1:]
    assert len(lines) == 8 and len(set(lines)) == 8


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602])
def test_a_file_that_is_open_to_others_lets_nobody_in(anna: Users, tmp_path: Path, mode: int) -> None:
    path = tmp_path / "users.toml"
    anna.write(path)
    path.chmod(mode)
    with pytest.raises(UsersRefused, match="open to others.*chmod 600"):
        Users.read(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("format = 1", "format = 2"), "format"),
        (('role = "operator"', 'role = "root"'), "role"),
        (('name = "anna"', 'name = "Anna"'), "name"),
        (('name = "anna"', 'name = "anna"\nadmin = true'), "admin"),
        (('salt = "', 'salt = "0'), "salt"),
        (("[[users]]", "[[users"), "not TOML"),
        (("format = 1", "format = 1" + " " * 70_000), "more than 65536 bytes"),
    ],
)
def test_what_is_not_as_it_was_written_is_refused_without_telling_what_it_has(
    anna: Users, tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    path = tmp_path / "users.toml"
    anna.write(path)
    text = path.read_text()
    secret = text.split('scrypt = "')[1][:20]
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(UsersRefused, match=said) as refused:
        Users.read(path)
    assert secret not in str(refused.value)


def test_a_name_twice_is_refused(anna: Users, tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    anna.write(path)
    text = path.read_text()
    path.write_text(text + text[text.index("[[users]]") :])
    with pytest.raises(UsersRefused, match="twice"):
        Users.read(path)


def test_a_change_of_the_file_counts_from_the_next_question_on(anna: Users, tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    file = UsersFile(path)
    assert file.current().entries() == []
    anna.write(path)
    assert file.current().check("anna", GOOD) == "operator"
    anna.without("anna").write(path)
    assert file.current().check("anna", GOOD) is None
    path.write_text("what?")
    with pytest.raises(UsersRefused):
        file.current()
    with pytest.raises(UsersRefused):
        file.current()  # and it is not what was read before
    path.unlink()
    assert file.current().entries() == []  # it was never kept: there may never have been one


@pytest.mark.parametrize(
    ("password", "said"),
    [
        ("short", "has 5 characters; allowed: 10 to 128"),
        ("", "has 0 characters"),
        ("x" * 129, "more than 128"),
        ("aaaabbbbccccdddd", "fewer than 5 different"),
        ("Password-1", "what is tried first \\(password\\)"),
        ("annabellaX", ""),
        ("anna-anna-anna", "fewer than 5 different"),
        ("kurt123456", "123456"),
        ("zeile\neins und zwei", "control characters"),
        (GOOD, ""),
    ],
)
def test_weak_passwords_are_refused_with_what_is_allowed(password: str, said: str) -> None:
    if not said:
        assert why_weak("anna", password) == ""
        return
    with pytest.raises(UsersRefused, match=said) as refused:
        Users.nobody().with_user("anna", password, "viewer")
    assert "allowed:" in str(refused.value)
    assert len(password) < 10 or password not in str(refused.value)


def test_a_password_that_is_mostly_the_name_is_refused() -> None:
    assert "tried first (schichtleiter)" in why_weak("schichtleiter", "Schichtleiter24")


@pytest.mark.parametrize("name", ["", "Anna", "1anna", "anna bell", "a" * 33, "anna\n"])
def test_a_name_is_one(name: str) -> None:
    with pytest.raises(UsersRefused, match="allowed are names"):
        Users.nobody().with_user(name, GOOD, "viewer")


# ---- the command


@pytest.fixture
def place(tmp_path: Path) -> list[str]:
    (tmp_path / "line.toml").write_text(line_template(2))
    return [str(tmp_path / "line.toml")]


def users(place: list[str], *arguments: str, typed: str | None = None) -> tuple[int, str]:
    command, *rest = arguments
    data = ["--data-dir", str(Path(place[0]).parent / "data")]
    result = CliRunner().invoke(app, ["users", command, *place, *rest, *data], input=typed)
    return result.exit_code, result.output


def test_a_user_from_the_first_day_to_the_last(place: list[str]) -> None:
    path = Path(place[0]).parent / "data" / OPERATOR_DATA / "users.toml"
    code, said = users(place, "list")
    assert code == 0 and "nobody may come in" in said
    assert users(place, "add", "anna", "--role", "operator", typed=GOOD + "\n")[0] == 0
    assert Users.read(path).check("anna", GOOD) == "operator"
    code, said = users(place, "add", "anna", typed=GOOD + "\n")
    assert code == 2 and "is there already" in said
    assert users(place, "password", "anna", typed="ein anderer Satz\r\n")[0] == 0
    assert Users.read(path).check("anna", "ein anderer Satz") == "operator"
    code, said = users(place, "list", "--json")
    assert code == 0 and '"role": "operator"' in said
    assert users(place, "remove", "anna")[0] == 0
    assert Users.read(path).entries() == []


@pytest.mark.parametrize(
    ("arguments", "typed", "said"),
    [
        (("add", "anna", "--role", "operater"), GOOD, "did you mean operator?"),
        (("add", "anna"), "password12", "what is tried first"),
        (("add", "anna"), "", "has 0 characters"),
        (("add", "Anna"), GOOD, "allowed are names"),
        (("password", "anan"), GOOD, "there is no user anan"),
        (("remove", "bert"), "", "there is no user bert"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_and_nothing_is_written(
    place: list[str], arguments: tuple[str, ...], typed: str, said: str
) -> None:
    code, output = users(place, *arguments, typed=typed + "\n")
    assert code == 2 and said in output and len(output.splitlines()) == 1
    assert not (Path(place[0]).parent / "data" / OPERATOR_DATA / "users.toml").exists()


def test_a_file_open_to_others_is_not_written_over(place: list[str], anna: Users) -> None:
    folder = Path(place[0]).parent / "data" / OPERATOR_DATA
    folder.mkdir(parents=True)
    anna.write(folder / "users.toml")
    (folder / "users.toml").chmod(0o644)
    code, said = users(place, "add", "bert", typed=GOOD + "\n")
    assert code == 2 and "chmod 600" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "said", "code"), [((GOOD, GOOD), "may come in", 0), ((GOOD, GOOD + "?"), "the two differ", 2)]
)
def test_at_a_terminal_it_is_asked_twice_and_not_echoed(
    place: list[str], typed: tuple[str, str], said: str, code: int
) -> None:
    data = str(Path(place[0]).parent / "data")
    child, terminal = pty.fork()
    if child == 0:  # a process with a terminal of its own
        os.execv(
            sys.executable, [sys.executable, "-m", "gateway.cli", "users", "add", *place, "anna", "--data-dir", data]
        )
    seen = b""
    try:
        for prompt, answer in zip((b"anna: ", b"again: "), typed, strict=True):
            while prompt not in seen:
                seen += os.read(terminal, 1000)
            os.write(terminal, answer.encode() + b"\n")
        while True:
            seen += os.read(terminal, 1000)
    except OSError:
        pass  # the terminal is gone with its process
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == code
    assert said in seen.decode() and GOOD not in seen.decode()
    os.close(terminal)


def test_the_role_of_somebody_who_is_in_already_is_the_files_of_now(anna: Users, tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    file = UsersFile(path)
    file.keep(file.current())
    assert file.role_of("anna") is None and not file.was_there
    anna.write(path)
    file.keep(file.current())
    assert file.role_of("anna") == "operator" and file.role_of("bert") is None
    anna.with_user("anna", GOOD, "viewer").write(path)
    file.keep(file.current())
    assert file.role_of("anna") == "viewer"
    path.write_text("nonsense")
    with pytest.raises(UsersRefused):
        file.keep(file.current())
    assert file.role_of("anna") == "viewer"  # nobody knows what was meant; who is at work must be able to stop
    anna.without("anna").write(path)
    file.keep(file.current())
    assert file.role_of("anna") is None


def test_a_file_that_is_gone_is_no_file_without_users(anna: Users, tmp_path: Path) -> None:
    """A data disk that is not mounted looks like that, and who is at work must be able to stop."""
    path = tmp_path / "users.toml"
    file = UsersFile(path)
    anna.write(path)
    file.keep(file.current())
    path.unlink()
    with pytest.raises(UsersRefused, match="cannot be read"):
        file.current()
    assert file.role_of("anna") == "operator"
    anna.without("anna").write(path)
    assert file.current().entries() == []


def test_no_question_about_a_role_waits_for_the_disk(
    anna: Users, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "users.toml"
    file = UsersFile(path)
    anna.write(path)
    file.keep(file.current())

    def asked(*_: object, **__: object) -> None:
        raise AssertionError("the disk was asked")

    for name in ("open", "stat", "read_bytes"):
        monkeypatch.setattr(Path, name, asked)
    assert file.role_of("anna") == "operator"


def test_of_two_who_change_the_users_at_once_neither_loses_what_they_did(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    names = [f"user{number}" for number in range(8)]

    def add(name: str) -> None:
        change(path, lambda users: users.with_user(name, GOOD, "viewer"))

    threads = [Thread(target=add, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.name for one in UsersFile(path).current().entries()] == names


def test_a_change_that_is_refused_changes_nothing_and_leaves_the_file_to_others(anna: Users, tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    anna.write(path)
    before = path.read_bytes()
    with pytest.raises(UsersRefused):
        change(path, lambda users: users.without("bert"))
    assert path.read_bytes() == before
    change(path, lambda users: users.without("anna"))
    assert UsersFile(path).current().entries() == []
    assert path.exists()  # one that is gone is taken for a fault of the disk
    assert (tmp_path / "users.lock").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("name", ["anonymous", "gateway", "sysid", "root"])
def test_nobody_is_called_as_the_audit_calls_what_is_no_person(name: str) -> None:
    with pytest.raises(UsersRefused, match=name):
        Users.nobody().with_user(name, GOOD, "viewer")
