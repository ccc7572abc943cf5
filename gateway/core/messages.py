"""What processes say to each other: commands and their replies (JSON), events (JSON), telemetry (see `telemetry`)."""

import zlib
from collections import Counter
from itertools import islice
from math import inf
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from gateway.core.deployment import Deployment, Epoch, Hash, InService, RecoveryPrediction, Region
from gateway.core.experiment import Experiment, experiment_hash
from gateway.core.finding import Finding, finding
from gateway.core.json_rows import TooLongAPiece, load_rows
from gateway.core.line import Name, Strict
from gateway.core.wiring_proof import MOST_DEVICES
from gateway.core.wiring_proof import Answer as ProofAnswer


class Arm(Strict):
    """SILENT or STOP to READY: prove limits, PLC and watchdogs; zero torque."""

    command: Literal["arm"] = "arm"


class Start(Strict):
    """READY to RUN: tension the web, then run at the set speed. HOLD to RUN: back to the set speed."""

    command: Literal["start"] = "start"


class Drill(Strict):
    """SILENT or STOP, and back to STOP: at rest every watchdog's feed is withheld, and its reaction seen."""

    command: Literal["drill"] = "drill"


class Prove(Strict):
    """READY, and back to STOP: at standstill one drive at a time pulls a little, and what answers proves the wiring."""

    command: Literal["prove"] = "prove"
    only: Annotated[list[Name], Field(max_length=MOST_DEVICES)] = []  #: devices that are proved anew; empty: all


class KeepProof(Strict):
    """At rest, after a drill and pulls that found nothing: the wiring is proved by them from now on."""

    command: Literal["keep-proof"] = "keep-proof"
    answers: Annotated[list[ProofAnswer], Field(max_length=MOST_DEVICES)] = []  #: to what no pull could show
    only: Annotated[list[Name], Field(max_length=MOST_DEVICES)] = []  #: as `Prove` had it


class Hold(Strict):
    """RUN to HOLD: ramp the speed to standstill, tension control stays on."""

    command: Literal["hold"] = "hold"


class Stop(Strict):
    """Any state: controlled stop, then torque off. Never refused."""

    command: Literal["stop"] = "stop"


class SetTension(Strict):
    """A tension set-point. Ramped at the line's rate, or made at once within `limits.tension_step_max_n`."""

    command: Literal["set"] = "set"
    span: Annotated[int, Field(ge=1)]
    tension_n: float
    step: bool = False


class SetSpeed(Strict):
    """The line speed set-point (unwinder). Ramped, or made at once within `limits.speed_step_max_m_per_s`."""

    command: Literal["speed"] = "speed"
    speed_m_per_s: float
    step: bool = False


class SelectRecipe(Strict):
    """All set-points of a recipe of the line's file, ramped."""

    command: Literal["recipe"] = "recipe"
    name: str


class RunExperiment(Strict):
    """In RUN, with set-points that stand: move them as the experiment says, then back."""

    command: Literal["experiment"] = "experiment"
    experiment: Experiment
    #: Under which it was judged and approved; a line that is not simulated takes no other. From the gateway only.
    proposal: Hash | None = None


class AbortExperiment(Strict):
    """End the experiment that runs; set-points go back to where they stood before it."""

    command: Literal["experiment-abort"] = "experiment-abort"


class Deploy(Strict):
    """Between two periods: this configuration controls the line from now on, on probation. From the gateway only."""

    command: Literal["deploy"] = "deploy"
    deployment: Deployment


class Renew(Strict):
    """The gateway is there and has nothing against the deployment: its lease begins anew."""

    command: Literal["renew"] = "renew"
    epoch: Epoch


class Keep(Strict):
    """The deployment on probation becomes the last known good."""

    command: Literal["keep"] = "keep"
    epoch: Epoch
    #: Its fallback is what is kept: from now on the line stops where that would not recover it. None: nothing watches.
    watch: RecoveryPrediction | None = None


class WatchGood(Strict):
    """The last known good, which runs, is watched by this from now on: another model has been accepted."""

    command: Literal["watch-good"] = "watch-good"
    watch: RecoveryPrediction


class Narrow(Strict):
    """The line is no longer as it was: what runs, and what it would go back to, goes no further than `region` from now
    on, and no prediction watches it. From the gateway only.

    `confine`: nobody knows what runs, so nobody is asked to slow the line down first. It slows down by itself, and an
    experiment ends. Else a line that shall run faster is left as it is, and a person is told.
    """

    command: Literal["narrow"] = "narrow"
    region: Region
    confine: bool = False


class Confirmed(Strict):
    """A person has confirmed what runs though nobody has judged it: it is guarded as a first one no more. From the

    gateway only, and again after each start of a loop: the audit knows it, not the loop's disk.
    """

    command: Literal["confirmed"] = "confirmed"
    configuration: Hash


class Rollback(Strict):
    """Back to the last known good, now. Where that runs, nothing changes."""

    command: Literal["rollback"] = "rollback"
    reason: Annotated[str, Field(min_length=1, max_length=500)]


class AskConfiguration(Strict):
    """What controls the line: the reply has it as `in_service`."""

    command: Literal["configuration"] = "configuration"


Operating = (
    Arm | Drill | Start | Prove | KeepProof | Hold | Stop | SetTension | SetSpeed | SelectRecipe | RunExperiment
    | AbortExperiment
)  # fmt: skip
Configuring = Deploy | Renew | Keep | WatchGood | Narrow | Confirmed | Rollback | AskConfiguration
Command = Annotated[Operating | Configuring, Field(discriminator="command")]
_command: TypeAdapter[Command] = TypeAdapter(Command)
#: What only the gateway's deployer says, never a person directly.
Deploying = Deploy | Renew | Keep | WatchGood | Narrow | Confirmed

PACKED = b"\x78"  #: what zlib has packed begins so, and no JSON
MAX_COMMAND = 4096  #: bytes of a command as JSON
MAX_DEPLOYMENT = 2 * 1024 * 1024  #: the same for those with matrices, unpacked
#: For which reading a message holds the interpreter, in one piece: 10 ns of long numbers, up to 32 ns of short ones
#: with exponents, on one of two busy processors of 2026. Others are slower.
HELD_S_PER_BYTE = 80e-9
HELD_SHARE = 0.1  #: of a period, that a piece of a message may hold it for
MOST_KEYS = 256  #: of one object of a command; none has forty
MOST_TOLD = 20  #: errors of one command


def in_words(command: Command) -> str:
    """A command as a person would type it: "set 3 44.0 step"."""
    if isinstance(command, RunExperiment):
        return f"experiment {command.experiment.name} ({experiment_hash(command.experiment)[:12]})"
    if isinstance(command, Deploy):
        return f"deploy {command.deployment.hash[:12]} as epoch {command.deployment.epoch}"
    if isinstance(command, Keep):
        return f"keep {command.epoch}"
    if isinstance(command, Narrow):
        return "narrow"
    if isinstance(command, WatchGood):
        return f"watch-good {command.watch.fallback[:12]}"
    values = command.model_dump()
    only = [f"only {name}" for name in values.pop("only", [])]
    told = [key if value is True else str(value) for key, value in values.items() if value is not False and value != []]
    return " ".join(told + only)


class Reply(Strict):
    """What was done, or why not. A refusal has changed nothing, but that a refused arming has released the devices."""

    ok: bool
    state: str  #: the loop's state after the command
    text: str  #: one sentence for a person, with what to do next where it was refused
    reasons: list[str] = []  #: every reason of a refusal
    findings: list[Finding] = []  #: the same as data; a driver's may be in words only
    in_service: InService | None = None  #: after a command about the configuration
    known: bool = True  #: False: whether it was done is not known yet; the events tell it once it is


class Event(Strict):
    """Something that happened once: a state change, a trip, a set-point. `data` holds the measured numbers."""

    time_s: float  #: monotonic
    kind: str
    text: str
    findings: list[Finding] = []  #: what led to it
    data: dict[str, Any] = {}


class BusReport(Strict):
    """How a bus and its devices fare, in the loop's words."""

    name: str
    absent: list[str]  #: devices that do not answer now
    timeouts: int  #: samples that did not come in time, since the loop's start
    malformed: int  #: frames and answers that were discarded
    reconnects: int
    last_error: str


BUS_REPORTS: TypeAdapter[list[BusReport]] = TypeAdapter(list[BusReport])


class MalformedMessage(Exception):
    """Bytes from outside that are no message; the text says why, and `findings` where it has a code."""

    def __init__(self, text: str, *findings: Finding) -> None:
        super().__init__(text)
        self.findings = findings


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Takes no longer than reading them, whatever is sent: strangers are heard here, within a period of the loop."""
    if len(pairs) > MOST_KEYS:
        raise MalformedMessage(f"an object with {len(pairs)} keys; allowed: {MOST_KEYS}")
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = sorted(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise MalformedMessage(f"key given twice: {', '.join(twice)}"[:MAX_COMMAND])
    return found


def command_bytes(command: Command) -> bytes:
    """`command` as it is sent: JSON, packed with zlib where it is longer than a short one may be."""
    payload = command.model_dump_json().encode()
    return payload if len(payload) <= MAX_COMMAND else zlib.compress(payload)


def most_at_once(period_s: float) -> int:
    """Bytes of a message that may be read in one piece while somebody waits for the interpreter once in `period_s`."""
    return min(MAX_DEPLOYMENT, max(MAX_COMMAND, round(min(HELD_SHARE * period_s / HELD_S_PER_BYTE, MAX_DEPLOYMENT))))


def parse_command(payload: bytes, period_s: float = inf) -> Command:
    """A command from outside. Raises MalformedMessage with every reason.

    One that could not be read without holding the interpreter for longer than a tenth of `period_s` is none.
    """
    packed = payload[:1] == PACKED
    if packed:
        payload = _unpacked(payload)
    elif len(payload) > MAX_COMMAND:
        raise MalformedMessage(
            f"a command has at most {MAX_COMMAND} bytes unless it is packed, this one {len(payload)}",
            finding("message-too-long", allowed_bytes=MAX_COMMAND),
        )
    most = most_at_once(period_s)
    try:
        document = load_rows(payload.decode(), most, _no_duplicates)
    except TooLongAPiece as error:
        raise MalformedMessage(
            f"{error.size_bytes} bytes to be read in one piece; at most {most} are within a tenth of a period",
            finding("message-piece-too-long", size_bytes=error.size_bytes, allowed_bytes=most),
        ) from error
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {error}") from error
    try:
        command = _command.validate_python(document)
    except ValidationError as error:
        told = islice(error.errors(include_url=False), MOST_TOLD)
        reasons = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in told)
        raise MalformedMessage(reasons[:MAX_COMMAND]) from error
    if packed and not isinstance(command, Deploy | Keep | WatchGood):
        raise MalformedMessage(
            f"only deploy, keep and watch-good may be packed; others have at most {MAX_COMMAND} bytes"
        )
    return command


def _unpacked(payload: bytes) -> bytes:
    """Never more than is allowed, however little was sent."""
    packer = zlib.decompressobj()
    try:
        unpacked = packer.decompress(payload, MAX_DEPLOYMENT)
    except zlib.error as error:
        raise MalformedMessage(f"not packed as zlib does: {error}") from error
    if packer.unconsumed_tail or not packer.eof:
        too_long = [finding("message-too-long", allowed_bytes=MAX_DEPLOYMENT)] if packer.unconsumed_tail else []
        raise MalformedMessage(f"longer than {MAX_DEPLOYMENT} bytes unpacked, or cut off", *too_long)
    return unpacked
