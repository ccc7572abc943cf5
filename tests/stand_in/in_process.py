"""The stand-in without a socket: what carries the client's requests hands them to the engine."""

from collections.abc import AsyncIterator

import httpx

from tests.stand_in.engine import Engine, HangUp, Response


class InProcess(httpx.AsyncBaseTransport):
    """For `LanguageModel(settings, transport=InProcess(engine))`: the real client, and no port."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        response = self._engine.handle(request.method, request.url.path, await request.aread())
        headers = {"content-type": response.content_type}
        return httpx.Response(response.status, headers=headers, stream=_Parts(response))


class _Parts(httpx.AsyncByteStream):
    def __init__(self, response: Response) -> None:
        self._response = response

    async def __aiter__(self) -> AsyncIterator[bytes]:
        try:
            async for part in self._response.parts:
                yield part
        except HangUp:
            raise httpx.RemoteProtocolError("peer closed connection without sending complete message body") from None
