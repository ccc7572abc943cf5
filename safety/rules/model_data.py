"""The data that a model is judged by are those that it was made from, or came after it; and they tell something."""

from datetime import datetime

from gateway.core.recording import joined
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.excitation import MOVING, least_seconds, near_m_per_s
from safety.findings import told

RULE = "model: data"


def check(case: Case) -> list[RuleFinding]:
    """Digest or date, excitation, and the range of speeds that the model says it was made from."""
    found = [told(RULE, *_origin(case))]
    if not case.excited:
        return [*found, told(RULE, False, (
            f"none of {len(case.data)} recent recordings has {least_seconds(case.line):g} s at one speed in which "
            f"every tension moves by {MOVING:g} times its noise: run an experiment, and identify on its data"
        ))]  # fmt: skip
    region, fastest = case.model.region, max(part.speed_m_per_s for part in case.excited)
    near = fastest + near_m_per_s(fastest, case.line)
    if not region.speed_to_m_per_s <= near:
        text = f"the model says that it was made up to {region.speed_to_m_per_s:.3g} m/s; the data go to {fastest:.3g}"
        return [*found, told(RULE, False, f"{text} m/s")]
    return [*found, told(RULE, True, f"{len(case.excited)} parts of recordings tell, up to {fastest:.3g} m/s")]


def made_from_these(case: Case) -> bool:
    """Whether the data's digest is that of a recording of the context, or of all of them."""
    digests = {recording.digest() for recording in case.recordings}
    if len(case.recordings) > 1:
        digests.add(joined(case.recordings).digest())
    return case.model.data.digest in digests


def _origin(case: Case) -> tuple[bool, str]:
    if made_from_these(case):
        return True, "the model was made from these recordings"
    made = datetime.fromisoformat(case.model.created)
    before = [one.path for one in case.context.data if datetime.fromisoformat(one.recorded) <= made]
    if case.context.data and not before:
        return True, "these recordings came after the model"
    return False, (
        f"the model was made from data with the digest {case.model.data.digest[:12]}, which is none of the context's "
        f"{len(case.recordings)} recordings; allowed: those very data, or only recordings that came after the model"
    )
