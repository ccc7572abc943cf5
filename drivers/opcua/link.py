"""Drives, load-cell amplifiers and the line PLC behind one OPC UA server, behind the driver port.

The client does not live here but at the other end of a channel (see `channel`). A cycle asks it one question: write
the commands of the cycle before, and read everything; what has come by the deadline counts. There is one question
at a time: while one is not answered, no other is asked, its cycle is missed and its commands are never written.
"""

import asyncio
from collections.abc import Mapping, Sequence, Set

from drivers.opcua.channel import Channel
from drivers.opcua.drive import Axis
from drivers.opcua.messages import Answer, Outcome, Question
from drivers.opcua.nodes import Reading
from drivers.opcua.plc import Plc
from drivers.opcua.prepare import Device, NoAnswer, prepare_devices, restore
from drivers.opcua.proof import ANSWERS_ALLOWED
from drivers.opcua.release import release_axes
from drivers.opcua.status import BAD_TRANSACTION_FAILED, is_done
from drivers.port import PrepareRefused
from gateway.core.finding import finding
from gateway.core.signals import Inputs, LinkHealth, Outputs
from gateway.tasks.cleanup import finish
from gateway.wording.catalogue import sentence

ANSWER_TIMEOUT_S = 0.3  #: without an answer the connection is dropped
PREPARE_TIMEOUT_S = 0.5  #: per question
CONNECT_PATIENCE_S = 3.0  #: for a connection, where one is waited for
START_PATIENCE_S = 20.0  #: for the engine, on a busy machine
PROOF_PERIOD_S = 1.0  #: between two looks at what proves the devices
HUNG_S = 1.0  #: past a question's deadline, until an engine that should have said something is ended


class OpcUaLink:
    """A `drivers.port.Link` for the devices behind one endpoint."""

    def __init__(self, name: str, endpoint: str, devices: Sequence[Device], channel: Channel, period_s: float) -> None:
        self.name = name
        self.health = LinkHealth()
        self._endpoint = endpoint
        self._devices = list(devices)
        self._channel = channel
        self._period_s = period_s
        self._serials: dict[str, str] = {}  #: by device, as `prepare` has read them
        self._noted: dict[Device, float] = {}  #: watchdogs before a `prepare` that has not come to an end, counts
        self._noted_on = 0  #: the connection of that
        self._to_leave: list[Axis] = []  #: that were written to before the silence, and were not released since
        self._to_leave_on = 0  #: the connection of that
        self._releasing = asyncio.Lock()
        self._withheld: Set[str] = frozenset()  #: not written to, to see their watchdogs fire
        self._questions_per_proof = max(1, round(PROOF_PERIOD_S / period_s))
        self._unproven = 0  #: questions of cycles since the last that asked for every proof
        self._number = 0  #: of the last question
        self._asked: Question | None = None  #: not answered yet
        self._idle = asyncio.Event()
        self._idle.set()
        self._waiter: asyncio.Future[Answer] | None = None  #: of a question beside the cycle
        self._connection = 0
        self._sent_s = 0.0
        self._cyclic = 0  #: the last question of a cycle
        self._open = 0  #: the same, while its readings still count
        self._proving: list[bool] = []  #: by device: the question asks for its proof
        self._writing: list[int] = []  #: by device: how many writes of the question are its own
        self._readings: dict[Device, tuple[Reading, ...]] = {}  #: of this cycle
        self._complete = asyncio.Event()

    async def open(self) -> None:
        """Start the engine and connect. Raises OSError; the link may be used all the same, and goes on trying then."""
        try:
            self._channel.start(self._on_answer, self._on_lost)
            await self._ask_patiently(START_PATIENCE_S)
        except (NoAnswer, OSError) as error:
            raise OSError(
                f"bus {self.name}: no connection to {self._endpoint}: {error}; "
                "check endpoint and security, and that the server runs"
            ) from error

    async def prepare(self) -> None:
        """Check every device; set and prove their watchdogs. Raises PrepareRefused with every reason.

        Where this is cancelled, `release` undoes what was written.
        """
        self.silence()
        try:
            await self._ask_patiently(CONNECT_PATIENCE_S)
        except NoAnswer as error:
            why = {"where": self._endpoint, "error": str(error)}
            reasons = [finding("server-not-connected", device=device.name, **why) for device in self._devices]
            raise PrepareRefused(reasons) from error
        connection = self._connection
        if self._noted_on != connection:  # they are of devices that may be others now
            self._noted.clear()
        self._noted_on = connection
        self._serials = {}
        reasons = await prepare_devices(self._ask, self._devices, self._noted, self._serials)
        if not reasons and self._connection != connection:
            names = ", ".join(device.name for device in self._devices)
            reasons = [finding("connection-lost-meanwhile", device=names)]
        if reasons:
            raise PrepareRefused(reasons)
        self._to_leave.clear()
        for device in self._devices:
            device.activate()

    @property
    def serials(self) -> Mapping[str, str]:
        return self._serials

    @property
    def watched(self) -> Set[str]:
        return {device.name for device in self._devices if isinstance(device, Axis | Plc)}

    def withhold(self, devices: Set[str]) -> None:
        self._withheld = devices

    def silence(self) -> None:
        """Nothing is written from now on; reading goes on. Who was written to has to be left in order yet."""
        commanded = [device for device in self._devices if isinstance(device, Axis) and device.may_write]
        if commanded:
            self._to_leave, self._to_leave_on = commanded, self._connection
        self._withheld = frozenset()
        for device in self._devices:
            device.forget()

    async def release(self) -> None:
        """Drives that are written to take their torque off; of those that have, supervision ends without a fault.

        What an arming that was cancelled has left half-way is undone. No cancellation cuts it; a server that does not
        answer takes the time of one question.
        """
        self.silence()
        await finish(self._release())

    async def _release(self) -> None:
        async with self._releasing:
            await self._leave_devices()

    async def _leave_devices(self) -> None:
        axes, self._to_leave = self._to_leave, []
        if self._to_leave_on != self._connection:  # another server may never have taken the last command
            axes = []
        troubles = await release_axes(self._ask, axes)
        if self._noted_on == self._connection:
            troubles += [sentence(failure) for failure in await restore(self._ask, self._noted)]
        elif names := ", ".join(device.name for device in self._noted):
            troubles.append(f"connected anew since an arming was cancelled: the watchdogs of {names} stay as they are")
        self._noted.clear()
        if troubles:
            self.health.last_error = f"bus {self.name}: {'; '.join(troubles)}"

    # the cycle

    def trigger(self, now_s: float) -> None:
        """Send the commands of the cycle before, and ask for everything."""
        self._sent_s = now_s
        self._open = 0
        self._readings.clear()
        writes = [self._writes_of(device) for device in self._devices]  # sent now or never
        self._channel.tend(now_s)
        if self._asked is not None:
            if now_s > self._asked.deadline_s + HUNG_S:
                self._channel.give_up("the OPC UA process does not answer")
            return
        proves_all = self._unproven + 1 >= self._questions_per_proof
        self._proving = [proves_all or device.proof.due for device in self._devices]
        self._writing = [len(of_device) for of_device in writes]
        reads = tuple(
            place
            for device, proving in zip(self._devices, self._proving, strict=True)
            for place in (*device.reads, *(device.proof.nodes if proving else ()))
        )
        flat = tuple(write for of_device in writes for write in of_device)
        if self._send(flat, reads, now_s + self._period_s, now_s + ANSWER_TIMEOUT_S):
            self._unproven = 0 if proves_all else self._unproven + 1
            self._open = self._cyclic = self._number
            self._complete.clear()

    def _writes_of(self, device: Device) -> list[tuple[int, float]]:
        """One that is withheld is not told to take its torque off either: its watchdog has to do it."""
        writes = device.take_writes()
        return [] if device.name in self._withheld else writes

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """What has come by `deadline_s`."""
        if self._open and not self._complete.is_set():
            over = asyncio.get_running_loop().call_at(deadline_s, self._complete.set)
            try:
                await self._complete.wait()
            finally:
                over.cancel()
        self._open = 0
        absent: list[str] = []
        for device in self._devices:
            for trouble in device.fill(inputs, self._sent_s, self._readings.get(device)):
                self.health.last_error = trouble
            self.health.timeouts += device.missed > 0
            if device.missed >= ANSWERS_ALLOWED:
                absent.append(device.name)
        self.health.absent = absent

    def write(self, outputs: Outputs) -> None:
        """What the next question writes."""
        for device in self._devices:
            if device.active and device.name not in self._withheld:
                try:
                    device.command(outputs)
                except ValueError as error:
                    self._discard(f"{device.name}: {error}")

    # questions and answers

    def _send(
        self,
        writes: tuple[tuple[int, float], ...],
        reads: tuple[int, ...],
        write_by_s: float,
        deadline_s: float,
        *,
        patient: bool = False,
    ) -> bool:
        self._number += 1
        question = Question(self._number, self._connection, write_by_s, deadline_s, patient, writes, reads)
        if not self._channel.ask(question):
            return False
        self._asked = question
        self._idle.clear()
        return True

    async def _ask(
        self,
        writes: tuple[tuple[int, float], ...],
        reads: tuple[int, ...],
        patience_s: float = PREPARE_TIMEOUT_S,
        *,
        connection: int | None = None,
    ) -> Answer:
        """A question beside the cycle, whose own have to wait meanwhile; see `prepare.Ask`. Raises NoAnswer."""
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S + HUNG_S):
                while not self._idle.is_set():  # the cycle may be faster again
                    await self._idle.wait()
        except TimeoutError as error:
            raise NoAnswer("the OPC UA process does not answer") from error
        if connection not in (None, self._connection):
            raise NoAnswer("connected anew meanwhile")
        deadline_s = asyncio.get_running_loop().time() + patience_s
        patient = not (writes or reads)
        waiter: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        if not self._send(writes, reads, deadline_s, deadline_s, patient=patient):
            raise NoAnswer("the OPC UA process does not run")
        self._waiter = waiter
        try:
            async with asyncio.timeout_at(deadline_s + HUNG_S):
                answer = await waiter
        except TimeoutError as error:
            raise NoAnswer("no answer in time") from error
        finally:
            self._waiter = None
        if answer.outcome is not Outcome.DONE:
            raise NoAnswer(answer.text)
        if connection not in (None, answer.connection):
            raise NoAnswer("connected anew meanwhile")
        return answer

    async def _ask_patiently(self, start_patience_s: float) -> None:
        """Whether there is a connection, after having waited for the engine and for one. Raises NoAnswer."""
        try:
            async with asyncio.timeout(start_patience_s):
                await self._channel.up.wait()
        except TimeoutError as error:
            raise NoAnswer("the OPC UA process has not started yet") from error
        await self._ask((), (), CONNECT_PATIENCE_S)

    def _on_answer(self, answer: Answer) -> None:
        asked = self._asked
        if asked is None or asked.number != answer.number:
            self._discard("an answer to no question")
            return
        self._asked = None
        self._idle.set()
        if answer.connection != self._connection:
            self.health.reconnects += self._connection != 0
            self._connection = answer.connection
            self._void_proofs()
        if answer.outcome in (Outcome.NO_CONNECTION, Outcome.FAILED):
            self._void_proofs()
        if answer.outcome is not Outcome.DONE:
            self.health.last_error = f"bus {self.name}: {answer.text}"
        if answer.number != self._cyclic:
            if self._waiter is not None and not self._waiter.done():
                self._waiter.set_result(answer)
            return
        self._take_written(answer.written)
        if answer.outcome is Outcome.DONE:
            self._take_readings(answer, asked)
        self._complete.set()

    def _take_written(self, written: tuple[int, ...]) -> None:
        """A refusal is heard whenever it comes. Where one is to blame, those that it took with it are not."""
        if any(not is_done(status) and status != BAD_TRANSACTION_FAILED for status in written):
            written = tuple(0 if status == BAD_TRANSACTION_FAILED else status for status in written)
        at = 0
        for device, count in zip(self._devices, self._writing, strict=True):
            if trouble := device.on_written(written[at : at + count]):
                self._discard(trouble)
            at += count

    def _take_readings(self, answer: Answer, asked: Question) -> None:
        in_time = self._open == asked.number
        if not in_time:
            self._discard(f"bus {self.name}: an answer after its cycle")
        at = 0
        for device, proving in zip(self._devices, self._proving, strict=True):
            end = at + len(device.reads)
            if in_time:
                self._readings[device] = answer.readings[at:end]
            at = end
            if proving:
                end = at + len(device.proof.nodes)
                device.proof.judge(answer.readings[at:end], commanded=device.active)
                at = end

    def _void_proofs(self) -> None:
        for device in self._devices:
            device.connection_lost()

    def _on_lost(self, why: str) -> None:
        """The engine has ended, and the connection with it."""
        self.health.last_error = f"bus {self.name}: {why}"
        asked, self._asked = self._asked, None
        self._idle.set()
        self._complete.set()
        self._void_proofs()
        if self._waiter is not None and not self._waiter.done() and asked is not None:
            self._waiter.set_result(Answer(asked.number, Outcome.FAILED, self._connection, text=why))

    def _discard(self, reason: str) -> None:
        self.health.malformed += 1
        self.health.last_error = reason

    async def close(self) -> None:
        """End the engine and its connection. Idempotent; no cancellation cuts it."""
        self.silence()
        await self._channel.close()
