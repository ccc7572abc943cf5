"""Who gets into the page, for how long, and who does not."""

import asyncio

import httpx
import pytest

from gateway.core.people import Role
from gateway.operator.page.login import MOST_CHECKS, TOKEN_HEADER
from gateway.operator.page.sessions import (
    FREE_TRIES,
    IDLE_S,
    LONGEST_S,
    LONGEST_WAIT_S,
    MOST_EACH,
    MOST_PLACES,
    MOST_SESSIONS,
    Session,
    Sessions,
    Tries,
)
from gateway.operator.places import share_of
from tests.operator.fake_line import PASSWORD, check
from tests.unit.page_support import Page, page
from tests.unit.supervisor_support import until

ASKED = (
    "/api/line",
    "/api/proposals",
    "/api/proposals/abcdef",
    "/api/courses/abcdef",
    "/api/asked/abcdef",
    "/api/records",
    "/api/tensions",
    "/events",
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.parametrize("path", ASKED)
def test_without_a_login_nothing_is_told(path: str):
    async def story() -> None:
        async with page() as there:
            assert (await there.browser.get(path)).status_code == 401

    asyncio.run(story())


def test_a_login_is_a_cookie_that_no_script_and_no_other_site_gets():
    async def story() -> None:
        async with page() as there:
            answer = await there.log_in("engineer")
            assert answer.json()["name"] == answer.json()["role"] == "engineer"
            kept = answer.headers["set-cookie"].lower()
            assert kept.startswith("r2rgate-8480=") and "httponly" in kept and "samesite=strict" in kept
            assert "secure" not in kept  # loopback without TLS: the browser would not send it
            assert len(kept.split("=")[1].split(";")[0]) >= 43  # 256 bits in base 64
            assert (await there.browser.get("/api/me")).json() == answer.json()

    asyncio.run(story())


def test_with_tls_the_cookie_is_sent_over_tls_alone():
    async def story() -> None:
        async with page(page="https://127.0.0.1:8480") as there:
            kept = (await there.log_in()).headers["set-cookie"]
            assert kept.startswith("__Host-r2rgate-8480=") and "Secure" in kept and "Path=/" in kept
            assert (await there.browser.get("/api/me")).json()["name"] == "operator"

    asyncio.run(story())


@pytest.mark.parametrize("name, password", [("operator", "wrong"), ("nobody", PASSWORD), ("", "")])
def test_a_wrong_name_and_a_wrong_password_are_told_alike(name: str, password: str):
    async def story() -> None:
        async with page() as there:
            answer = await there.browser.post("/api/login", json={"name": name, "password": password})
            assert answer.status_code == 403 and answer.json()["text"] == "name or password is wrong"
            assert "set-cookie" not in answer.headers

    asyncio.run(story())


@pytest.mark.parametrize("body", [b"", b"[]", b"{}", b'{"name": "a", "password": 1}', b"\xff", b"[" * 9000])
def test_what_is_no_login_is_refused(body: bytes):
    async def story() -> None:
        async with page() as there:
            sent = await there.browser.post("/api/login", content=body, headers={"content-type": "application/json"})
            assert sent.status_code == 400

    asyncio.run(story())


def test_who_fails_waits_each_time_longer_even_with_the_right_password():
    clock = Clock()

    async def story() -> None:
        async with page(clock=clock) as there:
            for _ in range(FREE_TRIES):
                wrong = await there.browser.post("/api/login", json={"name": "operator", "password": "x"})
                assert wrong.status_code == 403
            right = {"name": "operator", "password": PASSWORD}
            waits = await there.browser.post("/api/login", json=right)
            assert waits.status_code == 429 and waits.headers["retry-after"] == "1"
            clock.now_s += 1.0
            assert (await there.browser.post("/api/login", json=right)).status_code == 200

    asyncio.run(story())


def browser_from(there: Page, address: str) -> httpx.AsyncClient:
    base = there.line.operator.page
    transport = httpx.ASGITransport(there.app, client=(address, 50_000))
    return httpx.AsyncClient(transport=transport, base_url=base, headers={"origin": base})


def test_who_fails_from_one_address_after_the_other_of_a_network_of_their_own_waits_as_well():
    async def story() -> None:
        async with page() as there:
            for k in range(FREE_TRIES + 1):
                async with browser_from(there, f"2001:db8::{k}") as one:
                    answer = await one.post("/api/login", json={"name": "operator", "password": "x"})
                assert answer.status_code == (429 if k == FREE_TRIES else 403)
            async with browser_from(there, "2001:db8:0:1::1") as other:
                right = {"name": "operator", "password": PASSWORD}
                assert (await other.post("/api/login", json=right)).status_code == 200

    asyncio.run(story())


def test_whoever_tries_much_at_a_time_lets_others_in(monkeypatch: pytest.MonkeyPatch):
    async def story() -> None:
        checking, go = 0, asyncio.Event()

        async def slow(name: str, password: str) -> Role | None:
            nonlocal checking
            checking += name == "viewer"
            if name == "viewer":
                await go.wait()
            return await check(name, password)

        monkeypatch.setattr("tests.unit.page_support.check", slow)
        async with page() as there, browser_from(there, "192.0.2.1") as many, browser_from(there, "192.0.2.2") as other:
            tries = [many.post("/api/login", json={"name": "viewer", "password": "x"}) for _ in range(2 * MOST_CHECKS)]
            trying = [asyncio.create_task(one) for one in tries]
            await until(lambda: sum(one.done() for one in trying) == 2 * MOST_CHECKS - share_of(MOST_CHECKS))
            assert {one.result().status_code for one in trying if one.done()} == {503}
            right = {"name": "operator", "password": PASSWORD}
            assert (await other.post("/api/login", json=right)).status_code == 200
            assert checking == share_of(MOST_CHECKS)
            go.set()
            assert {(await one).status_code for one in trying} == {403, 503}

    asyncio.run(story())


def test_the_wait_doubles_has_an_end_and_is_forgotten():
    clock = Clock()
    tries = Tries(clock)
    waits: list[float] = []
    for _ in range(FREE_TRIES + 9):
        tries.failed("there", f"name-{len(waits) % 3}")
        waits.append(tries.wait_s("there"))
    assert waits[: FREE_TRIES + 2] == [0.0] * (FREE_TRIES - 1) + [1.0, 2.0, 4.0]
    assert waits[-1] == LONGEST_WAIT_S and tries.wait_s("elsewhere") == 0.0


def test_a_right_password_clears_the_tries_of_its_own_name_only():
    tries = Tries(Clock())
    for _ in range(FREE_TRIES):
        tries.failed("there", "otto")
        tries.went_well("there", "anna")
    assert tries.wait_s("there") > 0.0
    tries.went_well("there", "otto")
    assert tries.wait_s("there") == 0.0


def test_tries_from_ever_new_places_take_no_more_memory():
    tries = Tries(Clock())
    for place in range(MOST_PLACES + FREE_TRIES):
        for _ in range(FREE_TRIES):
            tries.failed(str(place), "otto")
    assert tries.wait_s("0") == 0.0 and tries.wait_s(str(MOST_PLACES)) > 0.0


def test_a_session_in_use_ends_with_the_shift():
    clock = Clock()
    sessions = Sessions(clock)
    key = sessions.begin("anna", "operator")
    while clock.now_s - 1000.0 <= LONGEST_S:
        found = sessions.use(key)
        assert found is not None and not found.is_idle
        clock.now_s += IDLE_S - 1.0
    assert sessions.use(key) is None


def test_who_only_looks_has_to_log_in_again_who_says_something_has_not():
    clock = Clock()

    async def story(*says: str) -> int:
        async with page(clock=clock) as there:
            await there.log_in()
            for _ in range(2):
                clock.now_s += 0.6 * IDLE_S
                for command in says:
                    await there.say(command)
                answer = await there.browser.get("/api/line")
                assert answer.status_code == 200 or clock.now_s > 1000.0 + IDLE_S
            return (await there.browser.get("/api/line")).status_code

    assert asyncio.run(story()) == 401
    assert asyncio.run(story("hold")) == 200


def test_looking_on_does_not_keep_a_session_alive():
    clock = Clock()
    sessions = Sessions(clock)
    key = sessions.begin("anna", "operator")
    clock.now_s += IDLE_S
    assert not found_in(sessions, key).is_idle
    clock.now_s += 1.0
    assert found_in(sessions, key).is_idle
    sessions.use(key)
    assert found_in(sessions, key).is_idle  # once it is, nothing makes it whole again
    clock.now_s = 1000.0 + LONGEST_S + 1.0
    assert sessions.find(key) is None


def found_in(sessions: Sessions, key: str) -> Session:
    found = sessions.find(key)
    assert found is not None
    return found


@pytest.mark.parametrize("anonymous, looks", [("none", 401), ("read", 200)])
def test_an_idle_session_still_stops_and_holds_and_does_nothing_else(anonymous: str, looks: int):
    clock = Clock()

    async def story() -> None:
        async with page(clock=clock, anonymous=anonymous) as there:
            token = (await there.log_in()).json()["token"]
            clock.now_s += IDLE_S + 1.0
            role = "viewer" if anonymous == "read" else None
            told = {"name": None, "role": role, "token": token, "idle": "operator"}
            for command in ("stop", "hold", "stop"):
                assert (await there.browser.get("/api/me")).json() == told
                assert (await there.say(command)).status_code == 200
                heard = there.gateway.said[-1]
                assert (heard.person.name, heard.said.command) == ("operator", command)
            assert (await there.say("start")).status_code == (await there.say("arm")).status_code == 401
            assert len(there.gateway.said) == 3
            for path in ("/api/line", "/api/proposals", "/api/records"):
                assert (await there.browser.get(path)).status_code == looks
            there.browser.headers[TOKEN_HEADER] = "another"
            assert (await there.say("stop")).status_code == 403
            clock.now_s += LONGEST_S
            there.browser.headers[TOKEN_HEADER] = token
            assert (await there.say("stop")).status_code == 401 and len(there.gateway.said) == 3

    asyncio.run(story())


def test_of_whoever_may_not_stop_or_is_no_user_any_more_nothing_is_left_when_idle():
    clock = Clock()
    roles: dict[str, Role | None] = {"operator": "operator", "viewer": "viewer"}

    async def story(name: str) -> None:
        async with page(clock=clock, role_of=roles.get) as there:
            await there.log_in(name)
            clock.now_s += IDLE_S + 1.0
            roles.pop("operator", None)
            assert (await there.say("stop")).status_code == 401 and there.gateway.said == []
            assert (await there.browser.get("/api/me")).json() == {"name": None, "role": None, "token": None}

    asyncio.run(story("operator"))
    asyncio.run(story("viewer"))


def test_of_too_many_sessions_the_longest_unused_goes():
    sessions = Sessions(Clock())
    keys = [sessions.begin(f"anna{i}", "operator") for i in range(MOST_SESSIONS)]
    sessions.use(keys[0])
    sessions.begin("bert", "viewer")
    assert sessions.find(keys[0]) is not None and sessions.find(keys[1]) is None


def test_of_too_many_sessions_of_one_name_the_oldest_ends_and_no_other():
    clock = Clock()
    sessions = Sessions(clock)
    other = sessions.begin("bert", "viewer")
    keys: list[str] = []
    for _ in range(MOST_EACH):
        keys.append(sessions.begin("anna", "operator"))
        clock.now_s += 1.0
    sessions.use(keys[0])
    assert all(map(sessions.find, keys))
    keys.append(sessions.begin("anna", "operator"))
    assert [sessions.find(key) is not None for key in keys] == [False] + [True] * MOST_EACH
    assert sessions.find(other) is not None


def test_lines_on_one_machine_have_cookies_of_their_own():
    async def story() -> None:
        async with page() as one, page(page="http://127.0.0.1:8481") as other:
            names = [(await there.log_in()).headers["set-cookie"].partition("=")[0] for there in (one, other)]
            assert names == ["r2rgate-8480", "r2rgate-8481"]

    asyncio.run(story())


def test_after_logging_out_the_cookie_is_worth_nothing():
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            kept = dict(there.browser.cookies)
            assert (await there.browser.post("/api/logout", json={})).status_code == 200
            there.browser.cookies.update(kept)
            assert (await there.browser.get("/api/me")).json()["role"] is None
            assert (await there.browser.get("/api/line")).status_code == 401

    asyncio.run(story())


def test_a_user_who_is_taken_away_says_nothing_more_though_logged_in():
    roles: dict[str, Role | None] = {"operator": "operator"}

    async def story() -> None:
        async with page(role_of=roles.get) as there:
            await there.log_in()
            del roles["operator"]
            assert (await there.say("start")).status_code == 401 and there.gateway.said == []
            assert (await there.browser.get("/api/line")).status_code == 401
            roles["operator"] = "operator"  # who comes back logs in again
            assert (await there.browser.get("/api/me")).json()["role"] is None

    asyncio.run(story())


def test_another_role_counts_at_once_and_the_session_goes_on():
    roles: dict[str, Role | None] = {"operator": "operator"}

    async def story() -> None:
        async with page(role_of=roles.get) as there:
            await there.log_in()
            roles["operator"] = "viewer"
            assert (await there.say("start")).status_code == 403
            assert there.gateway.said[-1].person.role == "viewer"
            roles["operator"] = "engineer"
            assert "archive" in (await there.browser.get("/api/line")).json()["may"]
            assert (await there.say("stop")).status_code == 200

    asyncio.run(story())


def test_whoever_has_no_name_looks_where_the_line_lets_them_and_says_nothing():
    async def story() -> None:
        async with page(anonymous="read") as there:
            assert (await there.browser.get("/api/me")).json() == {"name": None, "role": "viewer", "token": None}
            assert (await there.browser.get("/api/proposals")).status_code == 200
            assert (await there.say("stop")).status_code == 401
            assert there.gateway.said == []

    asyncio.run(story())
