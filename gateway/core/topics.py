"""The one table of what travels between processes: name, way, rate, whether it is kept, how long an answer may take.

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
    #: For whoever serves it to answer; then the place of the request is free for another one, and who asked is told.
    within_s: float = 60.0
    #: It does something, and is not cut when its time is over: what was begun comes to its end. Else it only reads.
    acts: bool = False


#: Of stop and hold, wherever they are said: the answer, or that there is none and what to press instead.
SAFE_S = 1.0


@dataclass(frozen=True)
class AgentTopic:
    """A request of which each agent has a topic of its own: `of(agent)`."""

    name: str  #: with * where the agent's name stands
    asks: Literal["phases", "agent"]
    answers: Literal["agent", "gateway"]
    most_per_s: float  #: of each agent
    kept: bool  #: written to the historian
    within_s: float = 60.0  #: as of `Topic`
    acts: bool = False

    def of(self, agent: AgentName) -> Topic:
        name, rate = self.name.replace("*", agent), f"{self.most_per_s:g}/s"
        return Topic(name, "request", rate, self.kept, self.most_per_s, self.within_s, self.acts)


LOOP_TELEMETRY = Topic("loop/telemetry", "publish", "once a period", kept=True)
LOOP_EVENT = Topic("loop/event", "publish", "100/s", kept=True)
LOOP_BUSES = Topic("loop/buses", "publish", "1/s", kept=False)
LOOP_SHOWN = Topic("loop/shown", "request", "20/s", kept=False, within_s=1.0)  #: AskShown -> LoopShown
LOOP_COMMAND = Topic("loop/command", "request", "100/s", kept=False, within_s=120.0, acts=True)
LOOP_HELLO = Topic("loop/hello", "request", "1/s", kept=False, within_s=1.0)  #: nothing -> Introduction
GATEWAY_COMMAND = Topic("gateway/command", "request", "100/s", kept=True, within_s=120.0, acts=True)
GATEWAY_STATUS = Topic("gateway/status", "request", "20/s", kept=False, within_s=2.0)
GATEWAY_PROPOSE = Topic("gateway/propose", "request", "1/s", kept=True, within_s=20.0, acts=True)
GATEWAY_PROPOSALS = Topic("gateway/proposals", "request", "20/s", kept=False, within_s=10.0)
GATEWAY_DECISION = Topic("gateway/decision", "request", "1/s", kept=True, within_s=60.0, acts=True)

#: ForPerson -> Reply
GATEWAY_FOR_PERSON = Topic("gateway/for-person", "request", "100/s", kept=True, within_s=25.0, acts=True)
GATEWAY_ALARM = Topic("gateway/alarm", "request", "10/s", kept=True, within_s=20.0, acts=True)  #: AlarmSaid -> Reply
GATEWAY_ACCESS = Topic("gateway/access", "request", "1/s", kept=True, within_s=20.0, acts=True)  #: AtTheDoor -> Reply
#: PastQuery -> RecordsTold, TensionsTold
GATEWAY_PAST = Topic("gateway/past", "request", "20/s", kept=False, within_s=10.0)
GATEWAY_COURSES = Topic("gateway/courses", "request", "20/s", kept=False, within_s=10.0)  #: ShowCourses -> CoursesTold
GATEWAY_ASKED = Topic("gateway/asked", "request", "20/s", kept=False, within_s=10.0)  #: ShowAsked -> AskedTold

TOPICS = (
    LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES, LOOP_SHOWN, LOOP_COMMAND, LOOP_HELLO, GATEWAY_COMMAND, GATEWAY_STATUS,
    GATEWAY_PROPOSE,
    GATEWAY_PROPOSALS, GATEWAY_DECISION, GATEWAY_FOR_PERSON, GATEWAY_ALARM, GATEWAY_ACCESS,
    GATEWAY_PAST, GATEWAY_COURSES, GATEWAY_ASKED,
)  # fmt: skip

# The bus of the agents. What is no row here nobody may send there: its access rules are made from this table.
#: Question -> Answer
AGENT_DECIDE = AgentTopic("agents/*/decide", "phases", "agent", 10.0, kept=False, within_s=1200.0)
#: ComputeRequest -> ComputeReply
AGENT_COMPUTE = AgentTopic("agents/*/compute", "phases", "agent", 1.0, kept=False, within_s=1200.0)
ASK_UNANSWERED = AgentTopic("ask/*/unanswered", "phases", "gateway", 1.0, kept=True, acts=True)  #: Unanswered -> Reply
ASK_PROPOSE = AgentTopic("ask/*/propose", "agent", "gateway", 1.0, kept=True, acts=True)  #: Proposal -> Reply
ASK_STATUS = AgentTopic("ask/*/status", "agent", "gateway", 10.0, kept=False, within_s=5.0)  #: nothing -> GatewayStatus
#: Query -> as it says
ASK_PROPOSALS = AgentTopic("ask/*/proposals", "agent", "gateway", 10.0, kept=False, within_s=30.0)
#: Proposal -> DryRun; Reply: refused
ASK_JUDGE = AgentTopic("ask/*/judge", "agent", "gateway", 1.0, kept=True, within_s=1200.0)
ASK_LOG = AgentTopic("ask/*/log", "agent", "gateway", 2.0, kept=True, acts=True)  #: Interaction, packed -> Reply
#: What is known of the line; the messages are those of gateway/core/line_queries.py. None of them changes anything.
ASK_MODEL = AgentTopic("ask/*/model", "agent", "gateway", 2.0, kept=False, within_s=30.0)  #: OfHash -> ModelTold
#: OfHash -> ControllerTold
ASK_CONTROLLER = AgentTopic("ask/*/controller", "agent", "gateway", 2.0, kept=False, within_s=30.0)
#: nothing -> RecordingList
ASK_RECORDINGS = AgentTopic("ask/*/recordings", "agent", "gateway", 0.5, kept=False, within_s=30.0)
#: OfRecording -> packed
ASK_RECORDING = AgentTopic("ask/*/recording", "agent", "gateway", 20.0, kept=False, within_s=30.0)
#: OfKnowledge -> KnowledgePart
ASK_KNOWLEDGE = AgentTopic("ask/*/knowledge", "agent", "gateway", 5.0, kept=False, within_s=30.0)

AGENT_TOPICS = (
    AGENT_DECIDE, AGENT_COMPUTE, ASK_UNANSWERED, ASK_PROPOSE, ASK_STATUS, ASK_PROPOSALS, ASK_JUDGE, ASK_LOG, ASK_MODEL,
    ASK_CONTROLLER, ASK_RECORDINGS, ASK_RECORDING, ASK_KNOWLEDGE,
)  # fmt: skip
