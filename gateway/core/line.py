"""The line description: what `line.toml` may say. Strict, frozen, SI.

Spans and rollers are numbered by their order in the file: span i lies between roller i-1 and roller i; roller 0 is
the unwinder, which the line PLC drives at v0 and which is not listed. What single values must satisfy stands here;
what several tables must satisfy together stands in `line_checks`.
"""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gateway.core.line_defaults import derived_defaults

Name = Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?$")]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(gt=0.0, lt=1.0)]

BRAKING_MOST_S = 60.0  #: after a web break torque goes off after this time, whatever still turns


class Strict(BaseModel):
    """Unknown keys, NaN, infinity, and text or booleans in place of numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Parameter(Strict):
    """A physical parameter: nominal value and how far the truth may lie from it, as a fraction either way."""

    value: Positive
    tolerance: Fraction


class Control(Strict):
    period_s: Annotated[float, Field(ge=0.001, le=0.1)] = 0.010
    latency_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.010  #: from a sample to the torque it causes
    cpu: Annotated[int, Field(ge=0)] | None = None  #: pin the loop to this processor; default: the last one
    priority: Annotated[int, Field(ge=1, le=90)] = 60  #: SCHED_FIFO priority, where permitted


class Limits(Strict):
    """What must never be left. Changed only here, by an engineer."""

    torque_nm: Positive  #: per drive, either direction
    torque_rate_nm_per_s: Positive
    tension_min_n: NonNegative
    tension_max_n: Positive
    tension_margin_n: NonNegative = 1.0  #: set-points keep this far from either: noise at a limit stops the line
    speed_max_m_per_s: Positive
    tension_step_max_n: NonNegative = 0.0  #: largest set-point change that may be made at once; larger ones are ramped
    #: Times that, the steps of all spans within 2 s: what the last roller's speed has to follow is their sum.
    steps_together: Annotated[float, Field(ge=1.0, le=60.0)] = 4.0
    speed_step_max_m_per_s: NonNegative = 0.0
    hold_periods: Annotated[int, Field(ge=1, le=3)] = 3  #: periods without a signal until STOP
    watchdog_s: Annotated[float, Field(ge=0.01, le=0.2)] = 0.1  #: the drives take torque off after this silence
    stuck_s: Annotated[float, Field(gt=0.0, le=60.0)] = 0.9  #: a load cell that shows one value for so long is stuck
    tensioning_time_s: Positive = 20.0  #: after `start`, every span must have reached the band within this time


class Moves(Strict):
    """How set-points move when nobody asks for a step."""

    shape: Literal["ramp", "minimum-jerk"] = "ramp"  #: of minimum jerk, the rates are the greatest on the way
    tension_rate_n_per_s: Positive = 20.0
    speed_rate_m_per_s2: Positive = 0.05
    stop_rate_m_per_s2: Positive = 0.1  #: the controlled stop
    stop_time_s: Annotated[float, Field(gt=0.0, le=120.0)] = (
        10.0  #: torque goes off after this time in STOP, whatever the speed
    )
    torque_off_rate_nm_per_s: Positive = 200.0  #: at the end of a stop
    #: After a web break: from the greatest speed to rest, as far as the drives can brake so fast.
    brake_time_s: Annotated[float, Field(gt=0.0, le=10.0)] = 7.0


class Tensioning(Strict):
    """Until every span carries tension: small limits of their own, for a web that may not be there."""

    #: Of a roller's surface; without this key a tenth of limits.speed_max_m_per_s, 0.1 m/s, or what a web stands that
    #: tightens at that speed, whichever is least.
    roller_speed_max_m_per_s: Positive | None = None
    torque_share: Annotated[float, Field(gt=0.0, le=2.0)] = 0.5  #: above what the tension that is asked for explains


class Stages(Strict):
    """What a start goes through before the line runs."""

    start_warning_s: Annotated[float, Field(ge=0.0, le=60.0)] = 3.0  #: before anything moves
    tensioning: Tensioning = Tensioning()


class Web(Strict):
    stiffness_n: Parameter  #: E A, modulus times cross-section
    tension_before_n: NonNegative = 0.0  #: T_0, tension ahead of span 1, as far as it acts on the rollers
    tension_after_n: NonNegative = 0.0  #: T_{n+1}, tension behind the last roller


class Roller(Strict):
    name: Name
    radius_m: Parameter
    inertia_kg_m2: Parameter
    friction_nms_per_rad: Parameter
    torque_nm: Positive | None = None  #: of its drive, either direction; None: limits.torque_nm


class Span(Strict):
    name: Name
    length_m: Parameter
    control: Literal["tension", "draw"] = "tension"  #: draw: no load cell, the roller keeps a speed ratio
    slack_max_m: Annotated[float, Field(ge=0.0, le=10.0)] = 0.2  #: of web that may hang in it at a start
    tension_min_n: NonNegative | None = None  #: None: as in [limits]; the same of the next
    tension_max_n: Positive | None = None


class CanopenBus(Strict):
    name: Name
    protocol: Literal["canopen"]
    interface: Literal["udp_multicast", "virtual", "socketcan"]
    channel: str
    port: Annotated[int, Field(ge=1, le=65535)] | None = None  #: udp_multicast only
    bitrate_bit_per_s: Literal[125_000, 250_000, 500_000, 800_000, 1_000_000] = 1_000_000


class ModbusTcpBus(Strict):
    name: Name
    protocol: Literal["modbus-tcp"]
    host: str
    port: Annotated[int, Field(ge=1, le=65535)] = 502


class OpcUaBus(Strict):
    """One server. Without security anybody on the network can command its devices."""

    name: Name
    protocol: Literal["opcua"]
    endpoint: str  #: opc.tcp://HOST:PORT, with a path where the server has one
    security: Literal["none", "Basic256Sha256"] = "none"  #: the latter signs and encrypts
    certificate: str | None = None  #: file, our own; this and the next two with security only
    private_key: str | None = None  #: file
    server_certificate: str | None = None  #: file; no other server is talked to


Channel = Annotated[int, Field(ge=1, le=60)]  #: counted from 1
Bus = Annotated[CanopenBus | ModbusTcpBus | OpcUaBus, Field(discriminator="protocol")]


class Device(Strict):
    name: Name
    bus: Name
    map: Name  #: device type, a file of `drivers/maps`
    address: Annotated[int, Field(ge=1, le=247)]  #: CANopen node (1 to 127), Modbus unit, or OPC UA instance


class Drive(Device):
    channel: Channel = 1  #: axis, of a device that moves several
    roller: Annotated[int, Field(ge=1)]
    rated_torque_nm: Positive
    direction: Literal["forward", "reversed"] = "forward"  #: of transport, for a torque and a speed above 0 of its own
    gear: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.0  #: turns of the motor for one of the roller
    #: After a web break it may brake its roller with so much, and feed so much power and energy into its DC link.
    #: Without torque and power the roller coasts; without an energy its DC link takes any.
    braking_torque_nm: Positive | None = None
    braking_power_w: Positive | None = None
    braking_energy_j: Positive | None = None

    @property
    def roller_torque_nm(self) -> float:
        """Its rated torque, as the roller has it."""
        return self.rated_torque_nm * self.gear


class LoadCell(Device):
    channel: Channel = 1  #: of the amplifier
    span: Annotated[int, Field(ge=1)]
    capacity_n: Positive  #: a reading beyond it is not believed
    sign: Literal["normal", "inverted"] = "normal"  #: of what it shows of a tension


class LinePlc(Device):
    #: From a request to the speed that the unwinder has; without this key: one period, after which it is written.
    speed_lag_s: Annotated[float, Field(ge=0.0, le=2.0)] | None = None


class Recipe(Strict):
    """Set-points for a grade. Draw-controlled spans take theirs as the tension their speed ratio is computed from."""

    name: Name
    tension_n: list[Positive]
    speed_m_per_s: NonNegative


class History(Strict):
    """What the gateway keeps on disk. The oldest goes first; six spans at 100 Hz write about 0.7 GB a day."""

    keep_days: Positive = 90.0  #: of telemetry
    keep_gb: Positive = 20.0  #: at most, of telemetry and events together
    keep_events_days: Positive = 3650.0


class Priorities(Strict):
    """What matters on this line: the weights w of the score S (eq. performance_score)."""

    rmse_per_n: NonNegative = 1.0
    settling_per_s: NonNegative = 0.2
    overshoot_per_pct: NonNegative = 0.01
    effort_per_n2m2s: NonNegative = 1e-5
    robustness_per_n: NonNegative = 0.1
    compute_per_s: NonNegative = 100.0


class Gate(Strict):
    """What a change must show before it may reach a drive, and who decides. Changed only here, by an engineer."""

    autonomy: Literal["approve-all", "approve-first", "closed"] = "approve-all"
    approvals: Annotated[int, Field(ge=1, le=2)] = (
        1  #: people that a change takes, where it takes a person; 2: different ones
    )
    small_share: Fraction = 0.1  #: approve-first: from what a person approved to what needs none
    authors: Annotated[list[Name], Field(max_length=32)] = ["rules", "agents", "engineer"]  #: who may propose
    proposal_max_bytes: Annotated[int, Field(ge=1024, le=16_777_216)] = 65_536
    expiry_max_s: Positive = 86_400.0  #: a proposal stands no longer
    cool_down_s: NonNegative = 30.0  #: from one change to the next
    verdict_max_s: Positive = 30.0  #: no verdict in time is a refusal
    probation_s: Positive = 30.0  #: under watch before a change is kept
    # The model by which proposals are judged
    innovation_low: Positive = 0.8  #: normalised innovation squared, on excited data
    innovation_high: Positive = 1.2
    data_max_age_s: Positive = 604_800.0
    alignment_max_s: Positive = 0.002  #: by which a channel may tell late, as its interval has it
    # Stability
    decay_min_per_s: Positive = 0.05  #: of the slowest mode, at the vertices of what the model leaves open
    delay_margin_min_s: Positive = 0.004  #: beyond the measured latency
    # Simulated corners of what the model leaves open
    corners: Annotated[int, Field(ge=8, le=1024)] = 32
    corner_sigmas: Positive = 3.0
    corner_least: Fraction = 0.05  #: of each parameter, either way, whatever the intervals say
    stress_torque_lag_s: NonNegative = 0.005  #: what every simulated line has beside its model
    stress_late_share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.05  #: of commands, late by a period
    stress_coulomb_nm: NonNegative = 2.0
    stress_eccentricity: Annotated[float, Field(ge=0.0, le=0.05)] = 0.005  #: of the radius
    tail_oscillation_max_n: Positive = 1.0
    tail_error_max_n: Positive = 3.0
    chatter_max_nm: Positive = 5.0  #: root mean square of the change of torque from period to period
    # Improvement: by how much a metric may be worse than in service, and than the baseline
    tolerance_share: NonNegative = 0.02
    tolerance_n: NonNegative = 0.1  #: a floor of the same, for tracking errors
    tolerance_settling_s: NonNegative = 0.1
    tolerance_overshoot_pct: NonNegative = 2.0
    fine_overshoot_pct: Annotated[float, Field(ge=0.0, le=20.0)] = (
        10.0  #: up to it no overshoot is worse than another; half of what converges
    )
    # A line without an accepted model
    first_speed_max_m_per_s: Positive = 0.02
    first_step_max_n: Positive = 4.0
    first_corner_share: Fraction = 0.4  #: of the tolerances: at its corners a first configuration is simulated

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.innovation_low < 1.0 < self.innovation_high:
            raise ValueError(
                f"innovation_low is {self.innovation_low:g} and innovation_high {self.innovation_high:g}; allowed: "
                "below 1 and above 1, which a true model has"
            )
        return self


class Agents(Strict):
    """Who is asked where the phases leave something to judgement. The rules decide wherever nobody else answers."""

    llm: Literal["off", "ollama"] = "off"
    url: Annotated[str, Field(pattern=r"^https?://")] = "http://127.0.0.1:11434"
    model: Annotated[str, Field(min_length=1, max_length=120)] = "qwen3:4b"
    temperature: Annotated[float, Field(ge=0.0, le=2.0)] = 0.2
    seed: Annotated[int, Field(ge=0, le=2_147_483_647)] = 1
    context_tokens: Annotated[int, Field(ge=2048, le=262_144)] = 16_384
    answer_tokens: Annotated[int, Field(ge=128, le=32_768)] = 2048
    answer_max_s: Positive = 180.0  #: for a question with all its tries; after it the rules decide
    load_max_s: Positive = 300.0  #: for a model to be loaded
    task_max_tokens: Annotated[int, Field(ge=1024)] = 200_000  #: of one commissioning, asked and answered
    computations_max: Annotated[int, Field(ge=0, le=8)] = 3  #: that a model may ask for before it answers; 0: none
    embedder: Annotated[str, Field(min_length=1, max_length=120)] = "lexical"  #: or minilm, or ollama:MODEL


class Network(Strict):
    """The agents' bus beyond this machine. Without this table it stays on it."""

    listen: str  #: tls/HOST:PORT
    certificate: str  #: file, PEM, with all that lead to its authority
    private_key: str  #: file, PEM
    authority: str  #: file, PEM: certificates of who signs the agents'
    names: Annotated[list[Name], Field(min_length=1, max_length=32)]  #: common names of certificates of agents


class Operator(Strict):
    """Where people reach the line: an OPC UA server and a web page, both of `r2rgate operator`."""

    opc_ua: str = "opc.tcp://127.0.0.1:4840"
    page: str = "http://127.0.0.1:8480"
    anonymous: Literal["none", "read"] = "none"  #: whether somebody without a name may look
    pki: str | None = None  #: folder of certificates; null: `pki` in the line's data folder
    sessions_max: Annotated[int, Field(ge=1, le=100)] = 20  #: of OPC UA clients
    nodesets: str | None = None  #: folder of companion specifications' node sets, as published; null: own types only


class Line(Strict):
    format: Annotated[int, Field(ge=1, le=1)]  #: not Literal: that takes `true` and 1.0 for 1
    site: Name
    line: Name
    description: str = ""
    control: Control = Control()
    limits: Limits
    moves: Moves = Moves()
    stages: Stages = Stages()
    web: Web
    rollers: Annotated[list[Roller], Field(min_length=1, max_length=60)]
    spans: Annotated[list[Span], Field(min_length=1, max_length=60)]
    buses: Annotated[list[Bus], Field(min_length=1)]
    drives: list[Drive]
    load_cells: list[LoadCell]
    plc: LinePlc
    history: History = History()
    priorities: Priorities = Priorities()
    gate: Gate = Gate()
    agents: Agents = Agents()
    network: Network | None = None
    operator: Operator = Operator()
    recipes: Annotated[list[Recipe], Field(min_length=1)]  #: the first is the one a line starts with

    @model_validator(mode="after")
    def _derive(self) -> Self:
        """What has a dimension and is not given follows from the rest of the file: the numbers above are one line's."""
        for name, derived in derived_defaults(self).items():
            table: Strict = getattr(self, name)
            if missing := {key: value for key, value in derived.items() if key not in table.model_fields_set}:
                object.__setattr__(self, name, table.model_copy(update=missing))  # frozen for everybody else
        return self

    @property
    def n(self) -> int:
        """Number of spans, and of driven rollers."""
        return len(self.spans)

    @property
    def longest_stop_s(self) -> float:
        """How long the line may take from a stop to torque off."""
        brakes = any(drive.braking_torque_nm and drive.braking_power_w for drive in self.drives)
        slowing_s = max(self.moves.stop_time_s, BRAKING_MOST_S if brakes else 0.0)
        return slowing_s + self.limits.torque_nm / self.moves.torque_off_rate_nm_per_s + 1.0
