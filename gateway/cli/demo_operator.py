"""A person at the line, scripted: looks at the status, gives commands, approves what the gate lets through.

Arming, starting and approving go through OPC UA, where the demonstration has a client. A stop goes straight to the
loop, as every stop of the command line does.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence

from gateway.cli.children import Children
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_orders import Approve, Call, Told
from gateway.cli.demo_panel import Panel
from gateway.cli.demo_people import SCRIPT
from gateway.cli.demo_progress import Progress
from gateway.cli.operate_commands import request
from gateway.cli.prove import prove
from gateway.cli.status_commands import parse_status
from gateway.core.finding import Finding
from gateway.core.messages import Arm, Command, Start, Stop
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.wording.catalogue import sentence

LOOK_S = 0.1
PROOF_REPLY_S = 60.0  #: a drill is answered once it is over
SETTLE_TIME_S = 60.0  #: a start warns, takes slack up slowly, and tensions the web before it runs
SLACK_N, SLACK_TIME_S = 2.0, 60.0  #: what a load cell shows of a web that has given way, and how long that may take
SETTLED_N = 0.6  #: a measured tension this near its set-point has settled (six times the sensors' noise)
SETTLED_FOR_S = 2.0
COMMENT = "the demonstration approves what the gate lets through"


class Operator:
    def __init__(self, children: Children, progress: Progress) -> None:
        self.progress = progress
        self.panel: Panel | None = None  #: its OPC UA client
        self.stops: list[str] = []  #: why the line stopped by itself
        self.run_folder = children.run_folder
        self._children = children
        self._stopping = False  #: a stop is nothing unexpected
        self._looked_s = 0.0
        self._mailbox = UnixMailbox()
        self._mailbox.connect({GATEWAY_STATUS}, self.run_folder / GATEWAY_SOCKET)

    async def close(self) -> None:
        if self.panel is not None:
            await self.panel.close()
        await self._mailbox.close()

    async def order(self, command: Command) -> None:
        self._stopping = isinstance(command, Stop)
        if self.panel is not None and isinstance(command, Arm | Start):
            told = await self._through_opc_ua(Call(method="Arm" if isinstance(command, Arm) else "Start"))
            self.progress.step(f"  over OPC UA: {told.sentence}")
            return
        reply = await request(self.run_folder, command, timeout_s=15.0)
        if not reply.ok:
            raise DemoFailed(f"{command.command}: {'; '.join([reply.text, *reply.reasons])}")

    async def look(self) -> GatewayStatus | None:
        """The status now; None while the gateway is not up."""
        self._children.check()
        self._looked_s = time.monotonic()
        try:
            status = parse_status(await self._mailbox.request(GATEWAY_STATUS, b"", 2.0))
        except Unreachable:
            return None
        self.progress.show(status)
        if status.loop.state == "STOP" and not self._stopping:
            told = [event.text for event in status.events if event.kind == "state"]
            raise DemoFailed(f"the line has stopped: {told[-1] if told else 'no event says why'}")
        return status

    async def keep_showing(self) -> None:
        """While others compute or wait; until it is cancelled. What is wrong, they find themselves."""
        while True:
            await asyncio.sleep(LOOK_S)
            if time.monotonic() - self._looked_s > 2.0 * LOOK_S:
                with contextlib.suppress(DemoFailed):
                    await self.look()

    async def wait(self, enough: Callable[[GatewayStatus], bool], within_s: float, what: str) -> None:
        """Look on until `enough(status)`."""
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            status = await self.look()
            if status is not None and enough(status):
                return
            await asyncio.sleep(LOOK_S)
        raise DemoFailed(f"{what} took longer than {within_s:g} s")

    async def has_stopped(self) -> bool:
        """Whether the line has stopped by itself."""
        self._stopping = True
        status = await self.look()
        return status is not None and status.loop.state == "STOP"

    async def prove(self) -> None:
        """The wiring, with the web at rest. Raises DemoFailed.

        Where no pull can show it, the script answers: the simulated line is wired as its file says, and the proof has
        by whom that was said.
        """

        def answered(question: Finding) -> bool:
            self.progress.step(f"  asked, and answered by {SCRIPT}: {sentence(question)}")
            return True

        self._stopping = True
        await self.wait(_slack, SLACK_TIME_S, "the web's giving way")  # of a proof before
        self.progress.step("proving the wiring: each watchdog, then one drive at a time")
        proved = await prove(
            lambda command: request(self.run_folder, command, PROOF_REPLY_S), self.look, answered, SCRIPT,
            lambda text: self.progress.step(f"  {text}"),
        )  # fmt: skip
        if not proved.ok:
            reply = proved.reply
            raise DemoFailed(f"{proved.step}: {'; '.join([reply.text, *reply.reasons])}")

    async def begin(self) -> None:
        """From rest to a line that is being tensioned."""
        self.progress.step("arming: limits, line PLC, load cells, the drives' watchdogs")
        await self.order(Arm())
        self.progress.step("tensioning the web, then to speed")
        await self.order(Start())

    async def recover(self, story: str, why: str) -> None:
        """Until torque is off; then a computer that has just stalled is given time to come to itself."""
        self.stops.append(why)
        self.progress.step(story)
        await self.wait_at_rest()
        await asyncio.sleep(1.0)

    async def wait_at_rest(self) -> None:
        """Until torque is off."""
        self._stopping = True
        await self.wait(_at_rest, 20.0, "the stop")

    async def wait_settled(self, tension_n: Sequence[float], speed_m_per_s: float) -> None:
        since_s = time.monotonic()

        def settled(status: GatewayStatus) -> bool:
            nonlocal since_s
            spans = zip(status.spans, tension_n, strict=True)
            near = all(span.setpoint_n == target and abs(span.error_n or 0.0) < SETTLED_N for span, target in spans)
            if not near or status.speed_setpoint_m_per_s != speed_m_per_s:
                since_s = time.monotonic()
            return time.monotonic() - since_s >= SETTLED_FOR_S

        await self.wait(settled, SETTLE_TIME_S, "settling")

    async def watch(self, for_s: float) -> None:
        """Look on for a while."""
        end_s = time.monotonic() + for_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            await asyncio.sleep(min(LOOK_S, left_s))
            await self.look()

    async def approve(self, proposal: str) -> str:
        """Through OPC UA, over what the server shows of it, which is returned. Raises DemoFailed where refused."""
        told = await self._through_opc_ua(Approve(proposal=proposal, comment=COMMENT))
        self.progress.step(f"  {SCRIPT}, over OPC UA, reads: {told.seen}")
        self.progress.step(f"  and approves: {told.sentence.partition('; ')[0]}")
        return told.seen

    async def _through_opc_ua(self, order: Call | Approve) -> Told:
        assert self.panel is not None  # with a client, if with a gate
        told = await self.panel.ask(order)
        if not told.ok:
            raise DemoFailed(f"refused over OPC UA: {told.sentence}")
        return told


def _slack(status: GatewayStatus) -> bool:
    return all(abs(span.tension_n or 0.0) <= SLACK_N for span in status.spans)


def _at_rest(status: GatewayStatus) -> bool:
    quiet = all(span.torque_nm == 0.0 and span.drive != "ENABLED" for span in status.spans)
    return status.loop.state in ("SILENT", "STOP") and quiet
