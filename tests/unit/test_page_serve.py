"""The page on its address: TLS, an address that is taken, a certificate that is none, and its end."""

import asyncio
import socket
import ssl
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from gateway.operator.page import guard, serve
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.page.serve import MOST_CONNECTIONS, CannotServe, listening, serve_on, tls_of
from tests.operator.fake_line import PASSWORD
from tests.unit.page_support import page
from tests.unit.supervisor_support import until


def certificate_in(folder: Path) -> tuple[Path, Path]:
    """Of 127.0.0.1, signed by itself."""
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([])
    now = datetime.now(UTC)
    names = x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))])
    signed = (
        x509.CertificateBuilder(name, name, key.public_key(), 1, now - timedelta(hours=1), now + timedelta(hours=1))
        .add_extension(names, critical=True)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    at, key_at = folder / "page.pem", folder / "page.key.pem"
    at.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    key_at.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return at, key_at


@pytest.mark.wires
def test_beyond_loopback_the_page_speaks_tls(tmp_path: Path):
    certificate, key = certificate_in(tmp_path)

    async def story() -> None:
        async with page(page="https://127.0.0.1:8480") as there:
            listener = socket.create_server(("127.0.0.1", 0))
            port = listener.getsockname()[1]
            serving = asyncio.create_task(serve_on(there.app, listener, tls_of(certificate, key)))
            trusted = await asyncio.to_thread(ssl.create_default_context, cafile=str(certificate))
            base = f"https://127.0.0.1:{port}"
            async with httpx.AsyncClient(base_url=base, verify=trusted) as browser:
                assert (await browser.get("/")).status_code == 200
            async with httpx.AsyncClient() as browser:
                with pytest.raises(httpx.HTTPError):
                    await browser.get(f"http://127.0.0.1:{port}/")
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(story())


@pytest.mark.wires
@pytest.mark.parametrize("sent", [b"", b"\x16\x03\x01\x02\x00\x01\x00"], ids=["nothing", "half a handshake"])
@pytest.mark.parametrize("with_tls", [False, True], ids=["http", "https"])
def test_past_any_number_of_connections_that_say_nothing_a_person_gets_in(tmp_path: Path, with_tls: bool, sent: bytes):
    """From the same address; those connections end meanwhile, so that they hold no descriptors either."""
    files = certificate_in(tmp_path) if with_tls else (None, None)
    scheme, flood = ("https" if with_tls else "http"), 4 * MOST_CONNECTIONS

    async def story() -> None:
        async with page(page=f"{scheme}://127.0.0.1:8480") as there:
            listener = socket.create_server(("127.0.0.1", 0))
            serving = asyncio.create_task(serve_on(there.app, listener, tls_of(*files)))
            base = f"{scheme}://127.0.0.1:{listener.getsockname()[1]}"
            trusted = await asyncio.to_thread(ssl.create_default_context, cafile=files[0]) if with_tls else False

            def browser() -> httpx.AsyncClient:
                return httpx.AsyncClient(base_url=base, verify=trusted, headers={"origin": base}, timeout=30.0)

            async with browser() as before, browser() as later:
                login = await before.post("/api/login", json={"name": "operator", "password": PASSWORD})
                later.headers[TOKEN_HEADER] = before.headers[TOKEN_HEADER] = login.json()["token"]
                later.cookies.update(before.cookies)
                silent = [await asyncio.open_connection("127.0.0.1", listener.getsockname()[1]) for _ in range(flood)]
                for _, writer in silent:
                    writer.write(sent)
                for one in (before, later):
                    assert (await one.post("/api/say", json={"command": "stop"})).status_code == 200
                await until(lambda: sum(map(is_ended, (one for one, _ in silent))) >= flood - MOST_CONNECTIONS)
                for _, writer in silent:
                    writer.close()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(story())


def is_ended(reader: asyncio.StreamReader) -> bool:
    return reader.at_eof() or reader.exception() is not None


@pytest.mark.wires
def test_a_handshake_that_is_not_finished_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(serve, "HANDSHAKE_S", 0.05)

    async def story() -> None:
        async with page(page="https://127.0.0.1:8480") as there:
            listener = socket.create_server(("127.0.0.1", 0))
            serving = asyncio.create_task(serve_on(there.app, listener, tls_of(*certificate_in(tmp_path))))
            reader, writer = await asyncio.open_connection("127.0.0.1", listener.getsockname()[1])
            writer.write(b"\x16\x03\x01\x02\x00\x01\x00")
            await until(lambda: is_ended(reader))
            writer.close()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(story())


def test_an_address_that_is_taken_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(CannotServe, match=address):
            listening(address)


@pytest.mark.parametrize("content", [None, "nothing"])
def test_a_certificate_that_is_none_is_told(tmp_path: Path, content: str | None):
    nothing = tmp_path / "page.pem"
    if content is not None:
        nothing.write_text(content)
    with pytest.raises(CannotServe, match=r"page\.pem"):
        tls_of(nothing, nothing)


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET /api/me HT",
        b"GET /api/me HTTP/1.1\r\nhost: 127.0.0.1\r\n",
        b"GET /api/me HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\nGET /api",
        b"POST /api/login HTTP/1.1\r\nhost: 127.0.0.1\r\norigin: http://127.0.0.1\r\ncontent-length: 9\r\n"
        b"content-type: application/json\r\n\r\n{",
        b"\x16\x03\x01\x02\x00\x01\x00",
    ],
)
def test_who_says_nothing_whole_takes_no_place(sent: bytes, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(serve, "IDLE_S", 0.05)
    monkeypatch.setattr(guard, "BODY_S", 0.05)

    async def story() -> None:
        async with page() as there:
            listener = socket.create_server(("127.0.0.1", 0))
            serving = asyncio.create_task(serve_on(there.app, listener))
            reader, writer = await asyncio.open_connection("127.0.0.1", listener.getsockname()[1])
            writer.write(sent)
            await reader.read()  # to its end: the page closes
            writer.close()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(story())


def test_when_it_ends_the_address_is_free_again():
    async def story() -> None:
        async with page() as there:
            listener = socket.create_server(("127.0.0.1", 0))
            port = listener.getsockname()[1]
            serving = asyncio.create_task(serve_on(there.app, listener))
            async with httpx.AsyncClient() as browser:
                assert (await browser.get(f"http://127.0.0.1:{port}/")).status_code == 200
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            assert serving.cancelled()
            listening(f"http://127.0.0.1:{port}").close()

    asyncio.run(story())
