"""A server may say only so much: who never ends a line, or a stream, does not fill this process's memory."""

from collections.abc import AsyncIterator

import httpx

MOST_RESPONSE_BYTES = 16_777_216  #: three times the longest answer that can be configured, a line for each token


class BoundedTransport(httpx.AsyncBaseTransport):
    """As `inner`, but a response of more than `most_bytes` is a RemoteProtocolError."""

    def __init__(self, inner: httpx.AsyncBaseTransport, most_bytes: int = MOST_RESPONSE_BYTES) -> None:
        self._inner = inner
        self._most_bytes = most_bytes

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        response = await self._inner.handle_async_request(request)
        if response.headers.get("content-encoding", "identity") != "identity":  # what is small may be huge unpacked
            await response.aclose()
            raise httpx.RemoteProtocolError("the server compresses what it says; nobody asked it to")
        assert isinstance(response.stream, httpx.AsyncByteStream)
        response.stream = _Bounded(response.stream, self._most_bytes)
        return response

    async def aclose(self) -> None:
        await self._inner.aclose()


class _Bounded(httpx.AsyncByteStream):
    def __init__(self, inner: httpx.AsyncByteStream, most_bytes: int) -> None:
        self._inner = inner
        self._left = most_bytes

    async def __aiter__(self) -> AsyncIterator[bytes]:
        async for part in self._inner:
            self._left -= len(part)
            if self._left < 0:
                raise httpx.RemoteProtocolError("the server said more than any answer has")
            yield part

    async def aclose(self) -> None:
        await self._inner.aclose()
