"""A line in its processes with people who propose, approve and roll back, over sockets as the commands do."""

import asyncio
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeVar

import numpy as np

from gateway.core.controller import Controller, config_hash, parse_controller
from gateway.core.decisions import Decide, ListProposals, ProposalList, ProposalShown, RollBackNow, ShowProposal
from gateway.core.deployment import Deployment, InService
from gateway.core.messages import AskConfiguration, Deploy, Reply, command_bytes
from gateway.core.proposal import GainsChange, Proposal, canonical, proposal_hash
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS, GATEWAY_PROPOSE, LOOP_COMMAND, Topic
from gateway.mailbox.inbox import come_again_s
from gateway.mailbox.paths import GATEWAY_DATA, GATEWAY_SOCKET, LOOP_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from sim_plant.recording import Recording
from tests.closed_loop.wire import WireLine
from tests.support.gateway_key import as_gateway

LOOK_S = 0.05
T = TypeVar("T")


class GateLine(WireLine):
    """Its probation is as short as what a line must show allows."""

    def __init__(self, folder: Path, seed: int = 1, spans: int = 3, probation_s: float = 5.5) -> None:
        super().__init__(folder, seed, spans, f"probation_s = {probation_s}\ncool_down_s = 0.5")

    @property
    def data(self) -> Path:
        """The line's."""
        return self.folder / "data"

    @property
    def gateway_data(self) -> Path:
        """Audit, stores and history."""
        return self.data / GATEWAY_DATA

    @property
    def first(self) -> Controller:
        return parse_controller((self.folder / "controller.json").read_bytes())

    def propose(self, controller: Controller, reason: str = "a test", for_s: float = 3600.0) -> str:
        """What was proposed, to be decided within `for_s`; it is being judged."""
        found, now = self.listed(), datetime.now(UTC)
        assert found is not None and found.in_service is not None
        proposal = Proposal(
            format=1, site=found.site, line=found.line, change=GainsChange(controller=controller),
            base=found.in_service, model=found.model, reason=reason, author="engineer",
            created=now.isoformat(), expires=(now + timedelta(seconds=for_s)).isoformat(),
        )  # fmt: skip
        reply = Reply.model_validate_json(self._ask(GATEWAY_PROPOSE, canonical(proposal)))
        while (again_s := come_again_s(reply)) is not None:
            time.sleep(again_s)
            reply = Reply.model_validate_json(self._ask(GATEWAY_PROPOSE, canonical(proposal)))
        assert reply.ok, reply
        return proposal_hash(proposal)

    def decide(self, proposal: str, approve: bool = True) -> Reply:
        """Of what is shown now."""
        shown = self.shown(proposal).shown or "0" * 64
        decision = Decide(proposal=proposal, shown=shown, approve=approve, comment="a test's")
        return Reply.model_validate_json(self._ask(GATEWAY_DECISION, decision.model_dump_json().encode()))

    def roll_back(self) -> Reply:
        return Reply.model_validate_json(self._ask(GATEWAY_DECISION, RollBackNow().model_dump_json().encode()))

    def listed(self) -> ProposalList | None:
        """None while the gateway is not there."""
        try:
            return ProposalList.model_validate_json(
                self._ask(GATEWAY_PROPOSALS, ListProposals().model_dump_json().encode())
            )
        except (Unreachable, ValueError):
            return None

    def shown(self, proposal: str) -> ProposalShown:
        query = ShowProposal(proposal=proposal).model_dump_json().encode()
        return ProposalShown.model_validate_json(self._ask(GATEWAY_PROPOSALS, query))

    def until(self, proposal: str, stage: str, within_s: float = 60.0) -> ProposalShown:
        """Look on until it is there; a refusal is the end, too."""
        found = self.look_on(lambda: self.shown(proposal), lambda found: found.stage in (stage, "refused"), within_s)
        assert found.stage == stage, found.why
        return found

    def look_on(self, look: Callable[[], T], enough: Callable[[T], bool], within_s: float = 60.0) -> T:
        deadline_s = time.monotonic() + within_s
        while not enough(found := look()):
            assert time.monotonic() < deadline_s, found
            time.sleep(LOOK_S)
        return found

    def in_service(self) -> str:
        return self.configuration().hash

    def configuration(self) -> InService:
        """The loop's own word, straight from it."""
        reply = Reply.model_validate_json(self._ask(LOOP_COMMAND, command_bytes(AskConfiguration())))
        assert reply.in_service is not None
        return reply.in_service

    def deploy(self, deployment: Deployment) -> Reply:
        """Past the gate, straight into the loop: with the gateway's key, as only its own user has it."""
        socket = self.children.run_folder / LOOP_SOCKET
        return asyncio.run(as_gateway(socket, self.line, self.data, Deploy(deployment=deployment)))

    def approved(self, controller: Controller, within_s: float = 60.0) -> str:
        """Proposed, accepted, approved: it runs, on probation."""
        proposal = self.propose(controller)
        self.until(proposal, "waiting", within_s)
        reply = self.decide(proposal)
        assert reply.ok, reply
        assert self.in_service() == config_hash(controller)
        return proposal

    def audit(self, *words: str) -> str:
        """What `r2rgate audit` says of this line."""
        return self._command("audit", *words, "--data-dir", self.data)

    def command(self, *words: str | Path) -> str:
        """What a command of `r2rgate` to this line says."""
        return self._command(*words, "--run-dir", self.children.run_folder)

    def _command(self, *words: str | Path) -> str:
        arguments = [sys.executable, "-m", "gateway.cli", *words]
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, (done.stdout[-3000:], done.stderr, self.status())
        return done.stdout

    def _ask(self, topic: Topic, payload: bytes) -> bytes:
        socket = LOOP_SOCKET if topic is LOOP_COMMAND else GATEWAY_SOCKET

        async def asked() -> bytes:
            mailbox = UnixMailbox()
            mailbox.connect({topic}, self.children.run_folder / socket)
            try:
                return await mailbox.request(topic, payload, 20.0)
            finally:
                await mailbox.close()

        return asyncio.run(asked())


def largest_step_nm(recording: Recording, from_s: float, to_s: float) -> float:
    """The largest change of a drive's commanded torque from one command to the next (world times)."""
    largest = 0.0
    for roller in range(1, recording.spans + 1):
        commands = [
            one["target_torque_nm"]
            for one in recording.of_kind("command")
            if one["roller"] == roller and from_s <= one["time_s"] <= to_s
        ]
        largest = max(largest, float(np.abs(np.diff(commands)).max()))
    return largest
