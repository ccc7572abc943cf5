"""Who is let in at the OPC UA server, and what those cannot do who are not, or only to look."""

import asyncio
import threading
from datetime import UTC, datetime
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.crypto import security_policies as policies

from gateway.files import read_bytes
from gateway.operator.opcua import login
from gateway.operator.opcua.trust import MOST_REJECTED, REJECTED, TRUSTED, TrustList, file_of
from tests.protocol.operator_support import PASSWORD, bench, comes, der, pair

CODES = ua.StatusCodes
SIGN, ENCRYPT = ua.MessageSecurityMode.Sign, ua.MessageSecurityMode.SignAndEncrypt
POLICIES = [policies.SecurityPolicyBasic256Sha256, policies.SecurityPolicyAes256Sha256RsaPss]


def run(story):
    asyncio.run(asyncio.wait_for(story(), 60.0))


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(login, "FIRST_DELAY_S", 0.001)


async def refused(client: Client) -> str:
    """How the server has ended it."""
    try:
        async with client:
            raise AssertionError("it was let in")
    except (ua.UaError, ConnectionError, TimeoutError) as error:
        return type(error).__name__


def test_both_policies_let_a_user_in():
    async def story():
        async with bench(spans=1) as b:
            for policy in POLICIES:
                async with b.connected("vera", policy=policy) as client:
                    await b.until(client, "Line.Operation.State", lambda found: found.StatusCode.is_good())

    run(story)


def test_only_endpoints_with_encryption_are_offered_and_no_anonymous_user():
    async def story():
        async with bench(spans=1) as b:
            found = await Client(b.url).connect_and_get_server_endpoints()
            assert {one.SecurityPolicyUri.rpartition("#")[2] for one in found} == {
                "Basic256Sha256", "Aes256_Sha256_RsaPss",
            }  # fmt: skip
            assert {one.SecurityMode for one in found} == {ENCRYPT}
            tokens = {token.TokenType for one in found for token in one.UserIdentityTokens}
            assert tokens == {ua.UserTokenType.UserName}
            assert {one.Server.ApplicationUri for one in found} == {"urn:r2rgate:test:line"}

    run(story)


def test_without_encryption_there_is_no_session():
    async def story():
        async with bench(spans=1) as b:
            plain = await b.client("otto", policy=None)
            await plain.connect_socket()
            await plain.send_hello()
            await plain.open_secure_channel()
            with pytest.raises(ua.uaerrors.BadSecurityModeRejected):
                await plain.create_session()
            plain.disconnect_socket()
            signed = await b.client("otto", mode=SIGN)
            assert await refused(signed)
            older = await b.client("otto", policy=policies.SecurityPolicyBasic256)
            assert await refused(older)
            assert b.checks == 0  # no password was looked at

    run(story)


def test_without_encryption_and_session_no_service_answers():
    async def story():
        async with bench(spans=1) as b:
            plain = Client(b.url)
            await plain.connect_socket()
            await plain.send_hello()
            await plain.open_secure_channel()
            for asked in (
                plain.uaclient.read(ua.ReadParameters(NodesToRead=[ua.ReadValueId(ua.NodeId(2258))])),
                plain.uaclient.call([ua.CallMethodRequest(b.id("Line"), b.id("Line.Stop"), [])]),
                plain.uaclient.browse(ua.BrowseParameters(NodesToBrowse=[ua.BrowseDescription()])),
                plain.uaclient.activate_session(ua.ActivateSessionParameters()),
            ):
                with pytest.raises(ua.uaerrors.BadSecurityModeRejected):
                    await asked
            plain.disconnect_socket()
            assert b.gateway.heard == []

    run(story)


def test_a_stranger_is_turned_away_kept_to_be_looked_at_and_let_in_once_trusted():
    async def story():
        async with bench(spans=1) as b:
            assert await refused(await b.client("otto", of="stranger", timeout_s=2.0))
            assert b.checks == 0
            kept = file_of(b.pki / REJECTED, der(pair("stranger")))
            await comes(kept.exists)
            assert kept.read_bytes() == der(pair("stranger"))
            assert any(f"r2rgate pki trust {kept}" in said and "urn:test:stranger" in said for said in b.said)
            trusted = kept.rename(b.pki / TRUSTED / "any-name.der")
            await b.looked_at_trust()
            async with b.connected("otto") as other, b.connected("otto", of="stranger"):
                assert b.sessions() == 2
                trusted.unlink()
                await comes(lambda: b.sessions() == 1)  # the session that is open ends, too
                await b.value(other, "Line.Connection.Fresh")
            assert await refused(await b.client("otto", of="stranger", timeout_s=2.0))

    run(story)


def test_rejected_certificates_do_not_fill_the_disk(monkeypatch):
    monkeypatch.setattr("gateway.operator.opcua.trust.KEEP_S", 0.0)

    async def story():
        async with bench(spans=1) as b:
            folder = b.pki / REJECTED
            folder.mkdir()
            for number in range(MOST_REJECTED + 5):
                (folder / f"{number}.der").write_bytes(b"x")
            assert await refused(await b.client("otto", of="stranger", timeout_s=2.0))
            await comes(file_of(folder, der(pair("stranger"))).exists)
            assert len(list(folder.iterdir())) == MOST_REJECTED

    run(story)


def test_a_client_must_call_itself_as_its_certificate_does():
    async def story():
        async with bench(spans=1) as b:
            client = await b.client("otto")
            client.application_uri = "urn:test:somebody-else"
            assert await refused(client) == "BadCertificateUriInvalid"

    run(story)


def test_a_wrong_name_or_password_is_refused_also_that_of_asyncuas_own_admin():
    wrong = [
        ("otto", "wrong password"),
        ("admin", ""),
        ("admin", PASSWORD),
        ("Admin", PASSWORD),
        ("otto", ""),
    ]

    async def story():
        async with bench(spans=1) as b:
            for user, password in wrong:
                assert await refused(await b.client(user, password)) == "BadUserAccessDenied", user

    run(story)


def test_somebody_without_a_name_stays_outside_unless_the_lines_file_lets_them_look():
    async def story():
        async with bench(spans=1) as b:
            assert await refused(await b.client(None)) == "BadIdentityTokenRejected"
        async with bench(spans=1, anonymous="read") as b, b.connected(None) as client:
            await b.until(client, "Line.Operation.State", lambda found: found.StatusCode.is_good())
            assert await b.call(client, "Stop") == (CODES.BadUserAccessDenied, [])
            assert await refused(await b.client(None, policy=None))  # nor then without encryption
            assert [(one.person.name, one.person.role) for one in b.gateway.heard] == [("anonymous", "viewer")]

    run(story)


def test_a_file_among_the_trusted_that_cannot_be_read_keeps_nobody_else_out(monkeypatch):
    def reads(path, most_bytes):
        if path.name == "0.der":
            raise PermissionError(13, "Permission denied")
        return read_bytes(path, most_bytes)

    async def story():
        async with bench(spans=1) as b:
            (b.pki / TRUSTED / "00.der").mkdir()
            (b.pki / TRUSTED / "0.der").write_bytes(bytes(len(der(pair("client")))))
            monkeypatch.setattr("gateway.operator.opcua.trust.read_bytes", reads)
            await b.looked_at_trust()
            async with b.connected("otto"):
                pass
            assert any("0.der cannot be read" in said for said in b.said)

    run(story)


@pytest.mark.wires
def test_a_disk_that_hangs_keeps_out_nobody_who_was_trusted_before(monkeypatch):
    hanging, over = threading.Event(), threading.Event()

    def hangs(_path):
        hanging.set()
        over.wait()
        return []

    async def story():
        async with bench(spans=1) as b:
            with monkeypatch.context() as disk:
                disk.setattr(Path, "iterdir", hangs)
                try:
                    await comes(hanging.is_set)
                    async with b.connected("otto") as client:
                        assert await b.call(client, "Stop") == (CODES.Good, [True, "done"])
                finally:
                    over.set()

    run(story)


def test_a_folder_of_the_trusted_that_is_gone_puts_nobody_out_and_a_file_that_is_taken_away_does():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            folder = b.pki / TRUSTED
            away = folder.rename(b.pki / "elsewhere")
            await comes(lambda: any("cannot be listed" in said for said in b.said))
            b.opcua.server.end_strangers()
            async with b.connected("vera"):
                assert await b.call(client, "Stop") == (CODES.Good, [True, "done"])
            away.rename(folder)
            for path in folder.iterdir():
                path.unlink()
            await comes(lambda: b.sessions() == 0)

    run(story)


def test_a_folder_that_cannot_be_listed_is_told_once_and_one_that_never_was_is_no_trouble(tmp_path, monkeypatch):
    said: list[str] = []
    trusted, stranger = TrustList(tmp_path, said.append, lambda: datetime.now(UTC)), der(pair("stranger"))
    trusted.look()
    assert said == [] and trusted.why_not(stranger) == "it is not trusted"
    trusted.look()
    assert file_of(tmp_path / REJECTED, stranger).read_bytes() == stranger and len(said) == 1

    def denied(_path):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as disk:
        disk.setattr(Path, "iterdir", denied)
        trusted.look()
        trusted.look()
    assert len(said) == 2 and "may this user read it?" in said[1]


def test_a_session_cannot_be_taken_up_by_another_connection():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as emma, b.connected("vera") as vera:
            theirs = vera.uaclient.protocol.authentication_token
            vera.uaclient.protocol.authentication_token = emma.uaclient.protocol.authentication_token
            with pytest.raises(ua.uaerrors.BadSessionIdInvalid):
                await b.value(vera, "Line.Operation.State")
            with pytest.raises(ua.uaerrors.BadSessionIdInvalid):
                await b.call(vera, "Stop")
            vera.uaclient.protocol.authentication_token = theirs
            assert b.gateway.heard == []

    run(story)


def test_a_subscription_belongs_to_its_session():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as emma, b.connected("vera") as vera:
            subscription = await emma.create_subscription(100, None)
            number = subscription.subscription_id
            with pytest.raises(ua.uaerrors.BadSubscriptionIdInvalid):
                await vera.uaclient.delete_subscriptions([number])
            with pytest.raises(ua.uaerrors.BadServiceUnsupported):
                await vera.uaclient.transfer_subscriptions(ua.TransferSubscriptionsParameters([number], False))
            assert number in b.opcua.server.iserver.subscription_service.subscriptions

    run(story)


def test_nobody_changes_the_address_space_or_registers_servers():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as client:
            for asked in (
                client.uaclient.add_nodes([ua.AddNodesItem()]),
                client.uaclient.delete_nodes(ua.DeleteNodesParameters()),
                client.uaclient.register_server(ua.RegisteredServer()),
            ):
                with pytest.raises(ua.uaerrors.BadServiceUnsupported):
                    await asked

    run(story)
