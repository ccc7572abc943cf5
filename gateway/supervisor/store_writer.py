"""Writing to the stores of a line: what is put into service, and what is believed no more.

Each write has a connection of its own, in a thread: a store that another program holds locked is waited for there, and
nothing else of the gateway waits with it.
"""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

from gateway.core.controller import Controller, ControllerRefused, config_hash, parse_controller
from gateway.core.line import Line
from gateway.core.proposal import GainsChange, ModelChange, Proposal
from gateway.files import MOST_BYTES, read_bytes
from gateway.supervisor import configurations as configurations_store
from gateway.supervisor import models as models_store
from gateway.supervisor.configurations import Configurations, ConfigurationsError, Origin, open_configurations
from gateway.supervisor.deployer_sides import NotTakenUp
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import Models, open_repository
from gateway.supervisor.peers import GATEWAY

#: Files of the loop from which a loop takes its first configuration, and how they are read.
STARTED_WITH: dict[str, Callable[[bytes], Controller]] = {
    "controller.json": parse_controller,
    "started-with.json": parse_controller,
    "configuration.json": lambda content: parse_controller(json.dumps(json.loads(content)["controller"]).encode()),
}


class StoreWriter:
    """Of the stores in `folder`, which are there; in `loops` lies what the loop is started with."""

    def __init__(self, line: Line, folder: Path, loops: Path, wall_clock: Callable[[], float]) -> None:
        self._line = line
        self._loops = loops
        self._configurations = folder / configurations_store.FILE_NAME
        self._models = folder / models_store.FILE_NAME
        self._wall_clock = wall_clock

    async def take_up(self, proposal: Proposal, verdict: str | None) -> None:
        """Store what is about to be put into service. Raises NotTakenUp. Once more changes nothing but a time."""
        try:
            await asyncio.to_thread(self._take_up, proposal, verdict)
        except (ConfigurationsError, ModelsError) as error:
            raise NotTakenUp(str(error)) from error

    async def supersede_models(self, but: str | None, why: str) -> None:
        """Mark every accepted model of the line but `but` as superseded. Raises ModelsError."""
        await asyncio.to_thread(self._supersede_models, but, why)

    async def store_given(self) -> None:
        """Store what the loop may have been started with: it tells only its hash. Raises ConfigurationsError."""
        await asyncio.to_thread(self._store_given)

    def _take_up(self, proposal: Proposal, verdict: str | None) -> None:
        change, now_s, line = proposal.change, self._wall_clock(), self._line
        if isinstance(change, GainsChange):
            origin = Origin(now_s, proposal.author, proposal.reason[:400], proposal.base, proposal.model, verdict)
            with open_configurations(self._configurations) as configurations:
                configurations.store(line.site, line.line, change.controller, origin)
        elif isinstance(change, ModelChange):
            with open_repository(self._models) as models:
                entry = models.store(change.model, now_s)
                _supersede(models, line, entry.id, now_s, f"by version {entry.version}")
                models.mark(entry.id, "accepted", now_s, proposal.reason[:400])

    def _store_given(self) -> None:
        found: list[tuple[str, Controller]] = []
        for name, read in STARTED_WITH.items():
            try:
                found.append((name, read(read_bytes(self._loops / name, MOST_BYTES))))
            except (OSError, ValueError, KeyError, TypeError, RecursionError, ControllerRefused):
                continue  # the loop says what it runs; a proposal finds that it is not known here
        site, line = self._line.site, self._line.line
        with open_configurations(self._configurations) as configurations:
            for name, controller in found:
                if configurations.get(site, line, config_hash(controller)) is None:
                    origin = Origin(self._wall_clock(), GATEWAY.name, f"found as {name}, with which the loop starts")
                    configurations.store(site, line, controller, origin)
            self._store_renamed(configurations)

    def _store_renamed(self, configurations: Configurations) -> None:
        """What was stored under a hash that was made with -0.0 is there under today's, too: the loop tells that one."""
        site, line = self._line.site, self._line.line
        for one in configurations.entries(site, line):
            if one.controller is not None and configurations.get(site, line, config_hash(one.controller)) is None:
                why = f"as version {one.version}, whose hash had been made before -0.0 was written as 0.0"
                configurations.store(site, line, one.controller, Origin(self._wall_clock(), GATEWAY.name, why, one.id))

    def _supersede_models(self, but: str | None, why: str) -> None:
        with open_repository(self._models) as models:
            _supersede(models, self._line, but, self._wall_clock(), why)


def _supersede(models: Models, line: Line, but: str | None, now_s: float, why: str) -> None:
    for other in models.entries(line.site, line.line):
        if other.state == "accepted" and other.id != but:
            models.mark(other.id, "superseded", now_s, why)
