"""What the gateway tells of a line's past: records of the audit, and tensions. JSON, strict; it changes nothing."""

from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from gateway.core.line import Strict

MOST_RECORDS, MOST_POINTS = 100, 2000


class RecordsAfter(Strict):
    """The oldest first. Without `after` the newest."""

    command: Literal["records"] = "records"
    after: Annotated[int, Field(ge=0)] | None = None  #: sequence
    most: Annotated[int, Field(ge=1, le=MOST_RECORDS)] = MOST_RECORDS


class TensionsBetween(Strict):
    """Of every span, thinned out to `points`; Unix times."""

    command: Literal["tensions"] = "tensions"
    from_wall_s: float
    to_wall_s: float
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = 600


PastQuery = Annotated[RecordsAfter | TensionsBetween, Field(discriminator="command")]
PAST_QUERY: TypeAdapter[RecordsAfter | TensionsBetween] = TypeAdapter(PastQuery)


class RecordTold(Strict):
    sequence: int
    wall_s: float
    kind: str
    who: str
    text: str  #: in a sentence, made here, never by a language model
    what: dict[str, Any]
    said: dict[str, str] = {}  #: the same in other languages, as far as there is one


class RecordsTold(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    last: int  #: sequence of the newest record there is
    records: list[RecordTold]


class TensionsTold(Strict):
    """Columns, all as long as `wall_s`; null where there is no value. Of a bucket the least and the greatest stay."""

    format: Annotated[int, Field(ge=1, le=1)]
    wall_s: list[float]
    tension_n: list[list[float | None]]  #: by span
    setpoint_n: list[list[float | None]]
    speed_m_per_s: list[float | None]  #: of the unwinder
    quality: list[list[Annotated[int, Field(ge=0, le=3)]]] = []  #: of `tension_n`, by span: numbers of Quality
