"""Bounds that asyncua's decoder lacks. Without them a few bytes from anybody keep it busy for ever.

They hold for the whole process and refuse nothing that a sound peer sends.
"""

import functools
from collections.abc import Sequence

from asyncua import ua
from asyncua.common.utils import Buffer, NotEnoughData
from asyncua.ua import ua_binary

MAX_NULLS = 1000


class _NullArrays:
    """Arrays of nothing: their elements take no bytes, so that the length of the message does not bound them."""

    def pack_array(self, data: Sequence[None] | None) -> bytes:
        return ua_binary.Primitives.Int32.pack(-1 if data is None else len(data))

    def unpack_array(self, data: Buffer, length: int) -> tuple[None, ...]:
        if not 0 <= length <= MAX_NULLS:
            raise ua.UaError(f"an array of {length} nulls; allowed: 0 to {MAX_NULLS}")
        return (None,) * length


@functools.cache
def bound_decoder() -> None:
    """Set the bounds. To be called before anything is decoded; again it does nothing."""
    read = Buffer.read

    def bounded_read(self: Buffer, size: int) -> bytes:
        # A negative length would read backwards: an array of such strings never ends.
        if size < 0:
            raise NotEnoughData(f"{size} bytes cannot be read")
        return read(self, size)

    setattr(Buffer, "read", bounded_read)  # noqa: B010 (asyncua declares neither as replaceable)
    setattr(ua_binary.Primitives1, "Null", _NullArrays())  # noqa: B010 (asyncua declares neither as replaceable)
