"""Wrong passwords: who guesses is slowed down, and nobody else."""

import asyncio

import pytest
from asyncua import ua
from asyncua.common.utils import ServiceError

from gateway.operator import access
from gateway.operator.opcua import login
from gateway.operator.opcua.trust import fingerprint
from gateway.operator.users import Users
from tests.protocol.operator_support import PASSWORD, USERS, bench, der, pair
from tests.protocol.test_operator_security import impatient, run

__all__ = ["impatient"]  #: the fixture


def test_guessing_becomes_slower_and_slower_for_that_client_alone(monkeypatch):
    slept: list[float] = []
    mine, other = "a" * 64, "b" * 64

    async def story():
        async def check(name, password):
            return "operator" if password == PASSWORD else None

        async def sleep(seconds):
            slept.append(seconds)

        monkeypatch.setattr(login.asyncio, "sleep", sleep)
        logins = login.Logins(check, USERS.get, anonymous_may_read=False)
        for certificate in (mine, mine, mine, other):
            with pytest.raises(ServiceError):
                await logins.by_password("otto", "guess", certificate)
        person = await logins.by_password("otto", PASSWORD, mine)
        assert person.name == "otto"

    run(story)
    assert slept == [0.001, 0.002, 0.004, 0.001]


def test_who_knows_one_password_guesses_those_of_others_no_faster(monkeypatch):
    slept: list[float] = []

    async def story():
        async def check(name, password):
            return "operator" if (name, password) == ("otto", PASSWORD) else None

        async def sleep(seconds):
            slept.append(seconds)

        monkeypatch.setattr(login.asyncio, "sleep", sleep)
        logins = login.Logins(check, USERS.get, anonymous_may_read=False)
        for _ in range(3):
            with pytest.raises(ServiceError):
                await logins.by_password("emma", "guess", "a" * 64)
            await logins.by_password("otto", PASSWORD, "a" * 64)
        with pytest.raises(ServiceError):
            await logins.by_password("otto", "mistyped", "a" * 64)
        await logins.by_password("otto", PASSWORD, "a" * 64)  # which clears otto's own
        with pytest.raises(ServiceError):
            await logins.by_password("emma", "guess", "a" * 64)

    run(story)
    assert slept == [0.001, 0.002, 0.004, 0.008, 0.008]


def test_a_clients_guesses_wait_for_each_other_and_those_of_all_are_two_at_a_time():
    async def story():
        running: list[str] = []
        most: list[list[str]] = []
        go = asyncio.Event()

        async def check(name, password):
            running.append(name)
            most.append(list(running))
            await go.wait()
            await asyncio.sleep(0)
            running.remove(name)

        logins = login.Logins(check, USERS.get, anonymous_may_read=False)
        guesses = [
            asyncio.create_task(logins.by_password(f"{of}{number}", "guess", of * 64))
            for number in range(3) for of in "abc"
        ]  # fmt: skip
        while not running:  # noqa: ASYNC110 (the first of them)
            await asyncio.sleep(0)
        go.set()
        answers = await asyncio.gather(*guesses, return_exceptions=True)
        assert all(isinstance(one, ServiceError) for one in answers)
        assert len(most) == 9 and max(map(len, most)) == 2
        assert all(len({name[0] for name in at_once}) == len(at_once) for at_once in most)

    run(story)


def test_what_a_user_may_is_what_the_users_file_says_now_not_at_their_login():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as otto, b.connected("vera") as vera:
            assert (await b.call(otto, "Hold"))[0] == ua.StatusCodes.Good
            b.users["otto"] = "viewer"
            assert (await b.call(otto, "Hold"))[0] == ua.StatusCodes.BadUserAccessDenied
            assert (await b.read(otto, "Line.Limits.TensionMax")).StatusCode.is_good()  # which a viewer may
            b.users["vera"] = "operator"
            assert (await b.call(vera, "Hold"))[0] == ua.StatusCodes.Good
            assert [one.person.role for one in b.gateway.heard] == ["operator", "viewer", "operator"]

    run(story)


def test_who_is_no_user_any_more_can_do_nothing_at_once_and_is_out_soon():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as vera:
            otto = await b.client("otto")
            await otto.connect()
            del b.users["otto"]
            try:
                assert (await b.call(otto, "Stop"))[0] == ua.StatusCodes.BadUserAccessDenied
            except (ConnectionError, ua.UaError):
                pass  # out already
            while b.sessions() > 1:  # noqa: ASYNC110 (the test's time limit ends what never comes)
                await asyncio.sleep(0.01)
            with pytest.raises((ConnectionError, ua.UaError)):
                await otto.get_node(ua.NodeId(2258)).read_value()
            assert b.gateway.heard == []
            assert (await b.read(vera, "Line.Limits.TensionMax")).StatusCode.is_good()
            otto.disconnect_socket()

    run(story)


def test_an_anonymous_session_stays_though_no_user_is_called_so():
    async def story():
        async with bench(spans=1, anonymous="read") as b, b.connected(None) as client:
            b.opcua.server.end_strangers()
            await asyncio.sleep(0)
            assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()
            assert (await b.call(client, "Stop"))[0] == ua.StatusCodes.BadUserAccessDenied

    run(story)


def test_the_gateway_hears_once_of_each_session_and_of_wrong_passwords_by_where_they_came_from(monkeypatch):
    monkeypatch.setattr(access, "REPORT_S", 0.0)

    async def story():
        async with bench(spans=1) as b:
            async with b.connected("otto") as client:
                await client.activate_session(username="otto", password=PASSWORD)  # the same session again
            for name in ("otto", "three old rollers"):  # the second typed into the wrong field
                with pytest.raises((ua.UaError, ConnectionError)):
                    async with await b.client(name, "guess"):
                        pass
            Users.nobody().with_user("otto", PASSWORD, "operator").write(b.folder / "users.toml")
            await b.access.look()
            users, came, wrong = b.gateway.at_the_door
            certificate = fingerprint(der(pair("client")))
            assert users.roles == {"otto": "operator"}
            assert (came.person.name, came.person.certificate, came.address) == ("otto", certificate, "127.0.0.1")
            (place,) = wrong.places
            assert (place.certificate, place.address, place.count) == (certificate, "127.0.0.1", 2)
            assert "rollers" not in wrong.model_dump_json()

    run(story)
