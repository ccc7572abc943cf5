"""The serial number of a CANopen node: what it is proved by, and what an abort of the moment makes of it."""

import asyncio
from typing import cast

import pytest

from drivers.canopen.prepare import read_serial
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent


class Node:
    """Answers 1018h:04 after it has failed so often."""

    def __init__(self, number: int, *failures: Exception) -> None:
        self.answer, self.failures = number.to_bytes(4, "little"), list(failures)

    async def upload(self, node: int, index: int, sub: int, size: int) -> bytes:
        assert (node, index, sub, size) == (7, 0x1018, 4, 4)
        if self.failures:
            raise self.failures.pop(0)
        return self.answer


def serial(node: Node) -> str:
    return asyncio.run(read_serial(cast(SdoBus, node), 7))


def test_a_number_is_told_and_none_is_where_there_is_none() -> None:
    aborted = SdoFailed("object 1018h sub 4: the device aborted")
    assert serial(Node(0x52520001)) == "0x52520001" and serial(Node(0)) == ""
    assert serial(Node(0x52520001, aborted)) == "0x52520001"
    assert serial(Node(0x52520001, aborted, aborted)) == ""


def test_a_node_that_does_not_answer_is_not_one_without_a_number() -> None:
    with pytest.raises(SdoSilent):
        serial(Node(1, SdoSilent("no answer")))
