"""A proof of the wiring is on record; one that the loop goes by and no record explains is told."""

import asyncio
from pathlib import Path
from typing import Any

from gateway.core.deployment import InService, WiringStatus
from gateway.core.messages import Command, Event, Reply
from gateway.core.proof import Grounds
from gateway.core.wiring_proof import WiringProof, proof_hash
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.supervisor.gate import PROVED, WIRING, Gate
from tests.support.gateway_key import to_loop_over
from tests.support.proved import proof_of_wiring
from tests.unit.deployer_support import LINE, Death, FakeJudge, FakeLoop, FakeSurroundings

PROOF = proof_of_wiring(LINE)
FORGED = "f" * 64


class ProvedLoop(FakeLoop):
    """Says of its wiring what it is told to."""

    def __init__(self) -> None:
        super().__init__(Death())
        self.wiring = WiringStatus(proved_wall_s=0.0, proof=proof_hash(PROOF))
        self.asked = 0

    async def tell(self, command: Command, grounds: Grounds | None = None) -> Reply:
        self.asked += command.command == "configuration"
        return await super().tell(command, grounds)

    def in_service(self) -> InService:
        return super().in_service().model_copy(update={"wiring": self.wiring})


async def opened(folder: Path, loop: ProvedLoop) -> Gate:
    """A gate that has asked the loop."""
    gate = Gate(
        LINE, InProcessMailbox(Hub()), to_loop_over(InProcessMailbox(Hub()), LINE), folder, FakeJudge(),
        lambda configurations, models: FakeSurroundings(loop), lambda kind, text, **data: None, lambda: loop.now_s,
        lambda: 1.8e9,
    )  # fmt: skip
    gate.loop = loop  # type: ignore[assignment]
    while gate.wiring() is None:
        await gate.look()
    return gate


def codes(gate: Gate) -> list[str]:
    return [one.code for one in gate.unexplained()]


def heard(kind: str, proof: WiringProof | None = None) -> Event:
    data = {} if proof is None else {"proof": proof.model_dump(mode="json")}
    return Event(time_s=0.0, kind=kind, text="", data=data)


def test_a_proof_that_the_audit_does_not_explain_is_told_and_one_that_it_does_is_not(tmp_path: Path) -> None:
    async def story() -> None:
        loop = ProvedLoop()
        gate = await opened(tmp_path, loop)
        try:
            assert codes(gate) == ["wiring-proof-unexplained"]
            recorded, append = asyncio.Event(), gate.audit.append

            async def appended(kind: str, *rest: Any) -> object:
                stored = await append(kind, *rest)
                if kind == PROVED:
                    recorded.set()
                return stored

            gate.audit.append = appended  # type: ignore[method-assign]
            gate.hear(heard(PROVED, PROOF))
            assert codes(gate) == ["wiring-proof-unexplained"]
            await recorded.wait()
            assert codes(gate) == []
        finally:
            await gate.close()

    async def kept() -> None:
        loop = ProvedLoop()
        gate = await opened(tmp_path, loop)
        try:
            assert codes(gate) == []  # the gateway is another one, and its audit the same
            loop.wiring = WiringStatus(not_read=True, proof=FORGED)
            gate.hear(heard(WIRING))
            await gate.look()
            (found,) = gate.unexplained()
            assert (found.code, found.parameters) == ("wiring-proof-unexplained", {"proof": FORGED[:12]})
            loop.wiring = WiringStatus()
            gate.hear(heard(WIRING))
            await gate.look()
            assert codes(gate) == []
        finally:
            await gate.close()

    asyncio.run(story())
    asyncio.run(kept())


def test_what_the_loop_tells_of_its_wiring_is_asked_about_at_once(tmp_path: Path) -> None:
    async def story() -> None:
        loop = ProvedLoop()
        gate = await opened(tmp_path, loop)
        try:
            await gate.look()
            before = loop.asked
            await gate.look()
            assert loop.asked == before
            loop.wiring = WiringStatus(not_read=True)
            gate.hear(heard(WIRING))
            await gate.look()
            assert loop.asked > before and gate.wiring() == loop.wiring
        finally:
            await gate.close()

    asyncio.run(story())
