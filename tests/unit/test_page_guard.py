"""What holds for every request to the page, and every answer."""

import asyncio
from pathlib import Path

import httpx
import pytest

from gateway.operator.page.guard import MOST_BYTES, names_of, why_not_from_here, why_not_this_host
from gateway.operator.page.login import TOKEN_HEADER
from tests.unit.page_support import HERE, page

STRANGERS = [
    {"origin": "https://elsewhere.example"},
    {"origin": "null"},
    {"origin": "http://127.0.0.1:9999"},
    {"origin": HERE, "sec-fetch-site": "cross-site"},
    {"origin": HERE, "sec-fetch-site": "same-site"},
    {"origin": HERE, "sec-fetch-site": "none"},
    {},
]


@pytest.mark.parametrize("path", ["/", "/main.js", "/words/de.json", "/api/me", "/nothing-here"])
def test_every_answer_tells_the_browser_to_run_nothing_from_elsewhere(path: str):
    async def story() -> None:
        async with page() as there:
            headers = (await there.browser.get(path)).headers
            policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
            assert policy["default-src"] == "'none'" and policy["frame-ancestors"] == "'none'"
            assert {policy[name] for name in ("script-src", "style-src", "connect-src")} == {"'self'"}
            assert headers["x-content-type-options"] == "nosniff"
            assert "server" not in headers

    asyncio.run(story())


@pytest.mark.parametrize("headers", STRANGERS)
def test_another_page_says_nothing_in_a_persons_name(headers: dict[str, str]):
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            del there.browser.headers["origin"]
            answer = await there.browser.post("/api/say", json={"command": "stop"}, headers=headers)
            assert answer.status_code == 403 and there.gateway.said == []

    asyncio.run(story())


@pytest.mark.parametrize("headers", [{"origin": HERE}, {"sec-fetch-site": "same-origin"}])
def test_the_page_itself_may(headers: dict[str, str]):
    assert why_not_from_here(headers | {"host": "127.0.0.1:8480"}) == ""


@pytest.mark.parametrize("token", ["", "wrong", "ä"])
def test_the_cookie_alone_says_nothing(token: str):
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            answer = await there.browser.post(
                "/api/say", json={"command": "stop"}, headers=[(TOKEN_HEADER.encode(), token.encode())]
            )
            assert answer.status_code == 403 and there.gateway.said == []

    asyncio.run(story())


@pytest.mark.slow
@pytest.mark.parametrize("host", ["elsewhere.example", "127.0.0.1.elsewhere.example:8480", "", "[", "169.254.1.1"])
def test_a_name_that_somebody_else_points_here_gets_no_answer(host: str):
    async def story() -> None:
        async with page(anonymous="read") as there:
            answer = await there.browser.get("/api/line", headers={"host": host})
            assert answer.status_code == 403 and "line-1" not in answer.text

    asyncio.run(story())


@pytest.mark.parametrize("host", ["127.0.0.1:8480", "localhost:8480", "[::1]:8480"])
def test_loopback_has_three_names(host: str):
    for bound in ("127.0.0.1", "localhost", "::1"):
        assert why_not_this_host(host, names_of(bound)) == ""


@pytest.mark.parametrize("host, allowed", [("127.0.0.2:8480", True), ("localhost:8480", False),
                                           ("127.0.0.1:8480", False), ("elsewhere.example", False)])  # fmt: skip
def test_another_address_of_loopback_has_its_own_name_only(host: str, allowed: bool):
    assert (why_not_this_host(host, names_of("127.0.0.2")) == "") is allowed


def test_what_is_reached_from_other_machines_has_any_name():
    assert why_not_this_host("line-7.plant.example", names_of("192.168.7.5")) == ""
    assert why_not_this_host("", names_of("192.168.7.5")) == "the request names no host"


@pytest.mark.slow
def test_what_is_too_long_is_not_read_to_its_end():
    async def story() -> None:
        async with page() as there:
            sent = 0

            async def endless():
                nonlocal sent
                while sent < 100 * MOST_BYTES:
                    sent += 1024
                    yield b" " * 1024

            answer = await there.browser.post(
                "/api/login", content=endless(), headers={"content-type": "application/json"}
            )
            assert answer.status_code == 413 and sent <= MOST_BYTES + 2048

    asyncio.run(story())


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None])
def test_a_form_of_another_page_is_no_json(kind: str | None):
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            headers = {} if kind is None else {"content-type": kind}
            request = there.browser.build_request("POST", "/api/say", content=b'{"command": "stop"}', headers=headers)
            answer = await there.browser.send(request)
            assert answer.status_code == 415 and there.gateway.said == []

    asyncio.run(story())


@pytest.mark.parametrize("path", ["/../app.py", "/%2e%2e/app.py", "/..%2fwords.toml", "//etc/passwd", "/%00"])
def test_no_file_but_the_pages_own_is_served(path: str):
    async def story() -> None:
        async with page() as there:
            url = httpx.URL(HERE).copy_with(raw_path=path.encode())
            answer = await there.browser.send(httpx.Request("GET", url, headers={"host": "127.0.0.1:8480"}))
            assert answer.status_code == 404

    asyncio.run(story())


def test_the_page_asks_nothing_of_any_other_place():
    static = Path("gateway/operator/page/static")
    named = {"http://www.w3.org/2000/svg", "https://github.com/leeoniya/uPlot"}
    for file in static.iterdir():
        text = file.read_text()
        for name in named:
            text = text.replace(name, "")
        assert "http://" not in text and "https://" not in text, file
        if file.suffix == ".html":
            assert " style=" not in text and "<style" not in text and " onclick" not in text


def test_the_whole_page_weighs_less_than_500_kb():
    weight = sum(file.stat().st_size for file in Path("gateway/operator/page/static").iterdir())
    assert weight < 500_000
