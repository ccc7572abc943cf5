"""Lines of sizes that the demonstration's is not: noisy encoders, spans without a load cell; the truth judges.

Seeds of the bench that looks for what may hurt by itself, each for what it had shown.
"""

import numpy as np
import pytest

from gateway.core.messages import Start
from gateway.core.states import Phase
from safety.tensioning import longest_tensioning_s
from tests.bench.harm_lines import drawn
from tests.bench.harm_runs import armed, healthy, ordered, threaded


@pytest.mark.parametrize("seed", [
    70019, 70021,  # the law began at what noise had last made of the torque: spans went slack
    80036,  # noise of the speed before, kept above 0, pulled the web on
    70012, 70020,  # default weights: torques at their limits
    73010, 73024,  # heavy rollers: to be accelerated on the ramp they take half of the web's tension
])  # fmt: skip
def test_a_line_with_noisy_encoders_starts_changes_its_grade_and_stops(seed):
    found = healthy("healthy", seed)
    assert not found.unsafe and not found.code, found


@pytest.mark.parametrize("seed", [
    1_070_018, 1_080_012,  # the roller before gave the span's web away while the others were tensioned
    1_090_010,  # six such spans in a row: each roller pulled as if it were alone
])  # fmt: skip
def test_spans_without_a_load_cell_come_to_production_with_a_tension(seed):
    loop, line = threaded(seed), drawn(seed).line
    assert not armed(loop)
    assert not ordered(loop, Start(), Phase.RUNNING, longest_tensioning_s(line) + 10.0)
    spans = np.array(drawn(seed).size.draw_spans) - 1
    share = loop.truth.world.tension_n[spans] / np.array(line.recipes[0].tension_n)[spans]
    assert (share > 0.3).all() and (share < 1.7).all(), share
    highest = loop.truth.recorder.unsafe_events
    assert not {kind: count for kind, count in highest.items() if count and kind != "tension-band"}
