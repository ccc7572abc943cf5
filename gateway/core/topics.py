"""The one table of what travels between processes: name, way, rate, and whether it is kept."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Topic:
    name: str
    way: Literal["publish", "request"]
    rate: str  #: at most
    kept: bool  #: written to the historian


LOOP_TELEMETRY = Topic("loop/telemetry", "publish", "once a period", kept=True)
LOOP_EVENT = Topic("loop/event", "publish", "100/s", kept=True)
LOOP_BUSES = Topic("loop/buses", "publish", "1/s", kept=False)
LOOP_COMMAND = Topic("loop/command", "request", "100/s", kept=False)
GATEWAY_COMMAND = Topic("gateway/command", "request", "100/s", kept=True)
GATEWAY_STATUS = Topic("gateway/status", "request", "20/s", kept=False)
GATEWAY_PROPOSE = Topic("gateway/propose", "request", "1/s", kept=True)
GATEWAY_PROPOSALS = Topic("gateway/proposals", "request", "20/s", kept=False)
GATEWAY_DECISION = Topic("gateway/decision", "request", "1/s", kept=True)

TOPICS = (
    LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES, LOOP_COMMAND, GATEWAY_COMMAND, GATEWAY_STATUS, GATEWAY_PROPOSE,
    GATEWAY_PROPOSALS, GATEWAY_DECISION,
)  # fmt: skip
