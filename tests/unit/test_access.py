"""Who came in, who did not, who may: told by the operator's process, on record at the gateway, and no disk filled."""

import asyncio
import threading
from pathlib import Path

import httpx
import pytest

from gateway.core.access import MOST_PLACES
from gateway.core.messages import Reply
from gateway.core.people import Person
from gateway.core.topics import GATEWAY_ACCESS
from gateway.files import read_bytes
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.operator import access
from gateway.operator.access import MOST_WAITING, REPORT_S, Access
from gateway.operator.line_side import LineSide
from gateway.operator.page.app import page_app
from gateway.operator.process import checked_by
from gateway.operator.users import Users, UsersFile
from gateway.supervisor.access_desk import AccessDesk
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import AT_ONCE, EVERY_S, MOST_NAMES, Bounded
from gateway.supervisor.record_words import in_a_sentence
from tests.unit.supervisor_support import line_of

OTTO = Person(name="otto", role="operator", through="page")
SECRET = "three old rollers"


class Both:
    """The door, and the gateway's desk, with a clock that is set."""

    def __init__(self, folder: Path) -> None:
        hub = Hub()
        self.now_s, self.audit_open = 0.0, True
        self.records: list[tuple[str, str, dict]] = []
        self.told: list[str] = []
        self.mailbox = InProcessMailbox(hub)
        self.path = folder / "users.toml"
        self.desk = AccessDesk(self.mailbox, self.note, lambda: self.now_s)
        self.side = LineSide(InProcessMailbox(hub))
        self.users = UsersFile(self.path)
        self.access = Access(self.side, self.users, self.told.append, lambda: self.now_s)

    async def note(self, kind, who, what):
        if not self.audit_open:
            raise AuditUnavailable("the disk is full")
        self.records.append((kind, who.name, dict(what)))

    def look(self, later_s: float = 0.0) -> list[str]:
        """The sentences of what is on record by it."""
        before = len(self.records)
        self.now_s += later_s
        asyncio.run(self.access.look())
        return [in_a_sentence(kind, who, what) for kind, who, what in self.records[before:]]


@pytest.fixture
def both(tmp_path) -> Both:
    return Both(tmp_path)


@pytest.fixture(scope="module")
def users() -> Users:
    return Users.nobody().with_user("otto", SECRET, "operator").with_user("vera", SECRET, "viewer")


def test_who_comes_in_is_on_record_with_role_way_and_place(both):
    both.look()
    both.access.came_in(OTTO, "192.0.2.7")
    assert both.look() == ["otto (operator, page) has come in from 192.0.2.7"]
    assert both.look() == []


def test_who_came_in_while_nothing_could_be_recorded_is_on_record_later_and_the_newest_of_too_many(both):
    both.audit_open = False
    for number in range(MOST_WAITING + 5):
        both.access.came_in(OTTO.model_copy(update={"name": f"n{number}"}), "")
    assert both.look() == []
    both.audit_open = True
    found = [one for one in both.look() if "has come in" in one]
    assert len(found) == MOST_WAITING
    told = [one.endswith("(and 5 others before, of whom nothing else is known)") for one in found]
    assert told == [True] + [False] * (MOST_WAITING - 1)
    assert both.records[-1][1].startswith(f"n{MOST_WAITING + 4} ")


def test_who_comes_and_goes_all_the_time_is_counted(both):
    both.look()
    for _ in range(300):
        both.access.came_in(OTTO, "")
        both.look()
    assert len(both.records) == 1 + AT_ONCE
    both.access.came_in(OTTO, "")
    (sentence,) = both.look(EVERY_S)
    assert sentence.endswith(f"(and {300 - AT_ONCE} times before, which are not on record)")


def test_wrong_logins_are_told_once_a_minute_by_place_and_never_with_what_was_typed(both, users):
    users.write(both.path)
    both.look()
    for name in ("otto", "otto", "vera", SECRET):
        both.access.refused("page", "192.0.2.7", None, name)
    both.access.refused("opc-ua", "192.0.2.8", "c" * 64, "nobody")
    assert both.look() == []
    (sentence,) = both.look(REPORT_S)
    assert sentence == "wrong names or passwords: 4 from 192.0.2.7 (page), 1 from 192.0.2.8 (opc-ua)"
    kind, _, what = both.records[-1]
    assert kind == "wrong-logins" and what["places"][0]["users"] == ["otto", "vera"]
    assert SECRET not in str(both.records) and both.look(REPORT_S) == []


def test_a_flood_from_many_places_is_one_short_record_a_minute(both):
    both.look()
    for number in range(100_000):
        both.access.refused("page", f"place {number}", None, "x" * 100)
    (sentence,) = both.look(REPORT_S)
    assert "99950 elsewhere" in sentence or len(sentence) == 400
    what = both.records[-1][2]
    assert len(what["places"]) == MOST_PLACES and what["elsewhere"] == 100_000 - MOST_PLACES
    assert len(str(what)) < 10_000


def test_wrong_logins_that_could_not_be_recorded_are_told_with_the_next(both):
    both.look()
    both.access.refused("page", "a", None, "x")
    both.audit_open = False
    both.look(REPORT_S)
    both.access.refused("page", "a", None, "x")
    both.access.refused("page", "b", None, "x")
    both.audit_open = True
    both.look(REPORT_S)
    assert [(one["address"], one["count"]) for one in both.records[-1][2]["places"]] == [("a", 2), ("b", 1)]


def test_every_change_of_the_users_is_on_record_and_nothing_that_proves_a_password(both, users):
    assert both.look() == ["users are nobody"]
    users.write(both.path)
    assert both.look() == ["users have changed: otto is new as operator, vera is new as viewer"]
    users.without("vera").with_user("otto", SECRET, "engineer").write(both.path)
    assert both.look() == ["users have changed: otto is engineer instead of operator, vera is gone"]
    assert both.look(10 * REPORT_S) == []  # told again, and known
    users.without("vera").with_user("otto", SECRET + "!", "engineer").write(both.path)
    assert both.look() == ["users have changed: the file is another, with the same names and roles"]
    both.path.write_text("nonsense")
    for _ in range(3):
        assert both.look(REPORT_S) == []
    (told,) = both.told
    assert "nobody can log in" in told
    for proof in ("salt", "scrypt", SECRET):
        assert proof not in str(both.records)


def test_users_that_change_all_the_time_are_on_record_in_the_end(both, users):
    for number in range(3 * AT_ONCE):
        (users if number % 2 else users.without("vera")).write(both.path)
        both.look()
    assert len(both.records) == AT_ONCE
    both.look(EVERY_S)
    assert both.records[-1][2]["roles"] == {"otto": "operator", "vera": "viewer"}
    assert "left_out" not in both.records[-1][2]


@pytest.mark.parametrize("payload", [b"", b"{}", b'{"happened": "came-in", "person": {"name": "A"}, "address": ""}'])
def test_what_is_none_of_these_is_not_understood(both, payload):
    async def asked():
        return Reply.model_validate_json(await both.mailbox.request(GATEWAY_ACCESS, payload, 1.0))

    reply = asyncio.run(asked())
    assert not reply.ok and reply.text == "not understood" and not both.records


def test_names_without_end_take_no_memory_without_end():
    bounded = Bounded(lambda: 0.0)
    for number in range(10 * MOST_NAMES):
        assert bounded.left_out(str(number)) == 0
    assert len(bounded._by_name) == MOST_NAMES  # noqa: SLF001 (nothing else tells)


def test_the_page_tells_who_has_logged_in_and_from_where_others_tried(both):
    async def check(name, password):
        return "operator" if password == SECRET else None

    async def story():
        app = page_app(line_of(1), both.side, check, lambda _: "operator", lambda: both.now_s, both.access)
        transport = httpx.ASGITransport(app, client=("127.0.0.9", 1))
        base = "http://127.0.0.1:8480"
        async with httpx.AsyncClient(transport=transport, base_url=base, headers={"origin": base}) as browser:
            for password in ("wrong", SECRET):
                await browser.post("/api/login", json={"name": "otto", "password": password})

    both.look()
    asyncio.run(story())
    assert both.look() == ["otto (operator, page) has come in from 127.0.0.9"]
    assert both.look(REPORT_S) == ["wrong names or passwords: 1 from 127.0.0.9 (page)"]


@pytest.mark.parametrize("tries", [1, 5 * AT_ONCE])
def test_what_happens_while_the_audit_is_away_is_on_record_once_it_is_back_however_often_it_was_told(both, tries):
    both.look()
    both.access.came_in(OTTO, "192.0.2.7")
    both.access.refused("page", "192.0.2.8", None, "x")
    both.audit_open = False
    for _ in range(tries):
        assert both.look(REPORT_S) == []
    both.audit_open = True
    assert both.look(REPORT_S) == [
        "otto (operator, page) has come in from 192.0.2.7", "wrong names or passwords: 1 from 192.0.2.8 (page)",
    ]  # fmt: skip


def test_what_came_too_often_stays_counted_while_the_audit_is_away():
    bounded = Bounded(lambda: now_s)
    now_s = 0.0
    assert [bounded.left_out("a") for _ in range(AT_ONCE + 3)] == [0] * AT_ONCE + [None] * 3
    for _ in range(2 * AT_ONCE):
        now_s += EVERY_S
        assert bounded.left_out("a") == 3
        bounded.undo("a", 3)


def test_the_newest_users_are_known_whether_on_record_or_not(both, users):
    desk = AccessDesk(InProcessMailbox(Hub()), both.note, lambda: both.now_s)
    assert desk.roles() is None
    both.look()
    both.audit_open = False
    users.write(both.path)
    assert both.look() == []
    assert both.desk.roles() == {"otto": "operator", "vera": "viewer"}


@pytest.mark.wires
def test_a_disk_that_does_not_answer_holds_up_neither_the_event_loop_nor_who_is_at_work(both, users, monkeypatch):
    users.write(both.path)
    answers = threading.Event()

    def reads(path, most_bytes):
        answers.wait()
        return read_bytes(path, most_bytes)

    async def story():
        await both.access.look()
        assert both.users.role_of("otto") == "operator"
        monkeypatch.setattr(access, "READ_S", 0.01)
        monkeypatch.setattr("gateway.operator.users.read_bytes", reads)
        threads, before = [], len(both.records)
        try:
            for _ in range(3):
                both.access.came_in(OTTO, "192.0.2.7")
                await both.access.look()
                threads.append(threading.active_count())
        finally:
            users.without("otto").write(both.path)
            answers.set()
        assert len(set(threads)) == 1  # no further one waits
        assert len(both.records) == before + 3
        assert both.users.role_of("otto") == "operator"
        while both.users.role_of("otto") is not None:
            await both.access.look()

    asyncio.run(story())
    assert "nobody can log in" in both.told[0] and "does not answer" in both.told[0]


def test_users_are_looked_at_while_the_gateway_does_not_answer(both, users, monkeypatch):
    monkeypatch.setattr(access, "LOOK_S", 0.01)

    async def never(_):
        await asyncio.Event().wait()

    async def story():
        monkeypatch.setattr(both.side, "at_the_door", never)
        running = asyncio.create_task(both.access.run())
        users.write(both.path)
        while both.users.role_of("otto") is None:  # noqa: ASYNC110 (the test's time limit ends what never comes)
            await asyncio.sleep(0.01)
        users.without("otto").write(both.path)
        while both.users.role_of("otto") is not None:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(story())


def test_a_users_file_that_is_gone_puts_nobody_out_and_is_told(both, users):
    users.write(both.path)
    both.look()
    both.path.unlink()
    assert both.look(2 * REPORT_S) == []
    assert both.users.role_of("otto") == "operator" and "nobody can log in" in both.told[0]


@pytest.mark.slow
def test_who_was_added_a_moment_ago_is_let_in_once_they_are_known(both, users):
    async def story():
        users.write(both.path)
        check = checked_by(both.users, both.told.append)
        checking = asyncio.create_task(check("otto", SECRET))
        while not checking.done():
            await both.access.renew()
            await asyncio.sleep(0.01)
        assert checking.result() == both.users.role_of("otto") == "operator"
        assert await check("otto", SECRET + "!") is None

    asyncio.run(story())
