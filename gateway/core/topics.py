"""The one table of what travels between processes: name, way, rate, and whether it is kept.

On the bus of the agents a site and a line stand before each name, so that two lines never meet.
"""

from dataclasses import dataclass
from typing import Literal, get_args

AgentName = Literal["sysid", "initial-control", "adaptation", "monitoring", "code"]
AGENT_NAMES: tuple[AgentName, ...] = get_args(AgentName)


@dataclass(frozen=True)
class Topic:
    name: str
    way: Literal["publish", "request"]
    rate: str  #: at most
    kept: bool  #: written to the historian
    most_per_s: float | None = None  #: requests; more are refused where it is served. None: not limited


@dataclass(frozen=True)
class AgentTopic:
    """A request of which each agent has a topic of its own: `of(agent)`."""

    name: str  #: with * where the agent's name stands
    asks: Literal["phases", "agent"]
    answers: Literal["agent", "gateway"]
    most_per_s: float  #: of each agent
    kept: bool  #: written to the historian

    def of(self, agent: AgentName) -> Topic:
        return Topic(self.name.replace("*", agent), "request", f"{self.most_per_s:g}/s", self.kept, self.most_per_s)


LOOP_TELEMETRY = Topic("loop/telemetry", "publish", "once a period", kept=True)
LOOP_EVENT = Topic("loop/event", "publish", "100/s", kept=True)
LOOP_BUSES = Topic("loop/buses", "publish", "1/s", kept=False)
LOOP_SHOWN = Topic("loop/shown", "request", "20/s", kept=False)  #: AskShown -> LoopShown
LOOP_COMMAND = Topic("loop/command", "request", "100/s", kept=False)
LOOP_HELLO = Topic("loop/hello", "request", "1/s", kept=False)  #: nothing -> Introduction
GATEWAY_COMMAND = Topic("gateway/command", "request", "100/s", kept=True)
GATEWAY_STATUS = Topic("gateway/status", "request", "20/s", kept=False)
GATEWAY_PROPOSE = Topic("gateway/propose", "request", "1/s", kept=True)
GATEWAY_PROPOSALS = Topic("gateway/proposals", "request", "20/s", kept=False)
GATEWAY_DECISION = Topic("gateway/decision", "request", "1/s", kept=True)

GATEWAY_FOR_PERSON = Topic("gateway/for-person", "request", "100/s", kept=True)  #: ForPerson -> Reply
GATEWAY_ALARM = Topic("gateway/alarm", "request", "10/s", kept=True)  #: AlarmSaid -> Reply
GATEWAY_ACCESS = Topic("gateway/access", "request", "1/s", kept=True)  #: AtTheDoor -> Reply
GATEWAY_PAST = Topic("gateway/past", "request", "20/s", kept=False)  #: PastQuery -> RecordsTold, TensionsTold
GATEWAY_COURSES = Topic("gateway/courses", "request", "20/s", kept=False)  #: ShowCourses -> CoursesTold
GATEWAY_ASKED = Topic("gateway/asked", "request", "20/s", kept=False)  #: ShowAsked -> AskedTold

TOPICS = (
    LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES, LOOP_SHOWN, LOOP_COMMAND, LOOP_HELLO, GATEWAY_COMMAND, GATEWAY_STATUS,
    GATEWAY_PROPOSE,
    GATEWAY_PROPOSALS, GATEWAY_DECISION, GATEWAY_FOR_PERSON, GATEWAY_ALARM, GATEWAY_ACCESS,
    GATEWAY_PAST, GATEWAY_COURSES, GATEWAY_ASKED,
)  # fmt: skip

# The bus of the agents. What is no row here nobody may send there: its access rules are made from this table.
AGENT_DECIDE = AgentTopic("agents/*/decide", "phases", "agent", 10.0, kept=False)  #: Question -> Answer
AGENT_COMPUTE = AgentTopic("agents/*/compute", "phases", "agent", 1.0, kept=False)  #: ComputeRequest -> ComputeReply
ASK_UNANSWERED = AgentTopic("ask/*/unanswered", "phases", "gateway", 1.0, kept=True)  #: Unanswered -> Reply
ASK_PROPOSE = AgentTopic("ask/*/propose", "agent", "gateway", 1.0, kept=True)  #: Proposal -> Reply
ASK_STATUS = AgentTopic("ask/*/status", "agent", "gateway", 10.0, kept=False)  #: nothing -> GatewayStatus
ASK_PROPOSALS = AgentTopic("ask/*/proposals", "agent", "gateway", 10.0, kept=False)  #: Query -> as it says
ASK_JUDGE = AgentTopic("ask/*/judge", "agent", "gateway", 1.0, kept=True)  #: Proposal -> DryRun; Reply: refused
ASK_LOG = AgentTopic("ask/*/log", "agent", "gateway", 2.0, kept=True)  #: Interaction, packed -> Reply
#: What is known of the line; the messages are those of gateway/core/line_queries.py. None of them changes anything.
ASK_MODEL = AgentTopic("ask/*/model", "agent", "gateway", 2.0, kept=False)  #: OfHash -> ModelTold
ASK_CONTROLLER = AgentTopic("ask/*/controller", "agent", "gateway", 2.0, kept=False)  #: OfHash -> ControllerTold
ASK_RECORDINGS = AgentTopic("ask/*/recordings", "agent", "gateway", 0.5, kept=False)  #: nothing -> RecordingList
ASK_RECORDING = AgentTopic("ask/*/recording", "agent", "gateway", 20.0, kept=False)  #: OfRecording -> packed
ASK_KNOWLEDGE = AgentTopic("ask/*/knowledge", "agent", "gateway", 5.0, kept=False)  #: OfKnowledge -> KnowledgePart

AGENT_TOPICS = (
    AGENT_DECIDE, AGENT_COMPUTE, ASK_UNANSWERED, ASK_PROPOSE, ASK_STATUS, ASK_PROPOSALS, ASK_JUDGE, ASK_LOG, ASK_MODEL,
    ASK_CONTROLLER, ASK_RECORDINGS, ASK_RECORDING, ASK_KNOWLEDGE,
)  # fmt: skip
