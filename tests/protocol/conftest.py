"""Servers on asyncua's stack take the standard's nodes from one copy: a worker makes them once, not for each test."""

from collections.abc import Iterator

import pytest
from asyncua.server.internal_server import InternalServer

from sim_plant.faces.opcua_stack import Stack


@pytest.fixture(autouse=True, scope="module")
def _standard_nodes_are_made_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InternalServer, "load_standard_address_space", Stack.load_standard_address_space)
        yield
