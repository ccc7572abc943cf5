"""What a loop has recorded, as the data of identification."""

from dataclasses import replace

import numpy as np
import pytest

from tests.closed_loop.recorded import real_plant, recorded, without


@pytest.fixture(scope="module")
def recording():
    return recorded(real_plant(), duration_s=1.0, speeds_m_per_s=(0.05, 0.1))


def test_a_recording_is_what_happened_on_the_line(recording):
    assert recording.samples == 200 and recording.n == 6
    assert np.allclose(np.diff(recording.time_s), 0.01)
    assert recording.controlled.all() and np.isfinite(recording.tension_n).all()
    # The paper's roller equation, over a period and without its noise: a torque acts a period after its sample.
    radius, inertia, friction, period = 0.035, 1.0, 15.0, recording.period_s
    tension, speed, torque = recording.tension_n, recording.speed_m_per_s, recording.torque_nm
    web = np.hstack((tension[:, 1:], np.zeros((200, 1)))) - tension
    for delay in (0, 1, 2):
        acting = torque[2 - delay : 199 - delay]
        rate = radius**2 / inertia * web[2:-1] - friction / inertia * speed[2:-1] + radius / inertia * acting
        off = float(np.sqrt(np.mean((np.diff(speed[2:], axis=0) / period - rate) ** 2)))
        assert (off < 0.06) == (delay == 1)


def test_gaps_and_unknown_samples_divide_it(recording):
    assert [part.samples for part in recording.stretches(1)] == [200]
    gap = without(recording, 50, 60)
    assert [part.samples for part in gap.stretches(1)] == [50, 140]
    tension = gap.tension_n.copy()
    tension[100, 2] = np.nan
    parts = replace(gap, tension_n=tension).stretches(60)
    assert [part.samples for part in parts] == [89]
    assert np.array_equal(parts[0].time_s, gap.time_s[101:])
    tension[:, 2] = np.nan  # a span without a load cell
    assert [part.samples for part in replace(gap, tension_n=tension).stretches(1)] == [50, 140]
    stopped = gap.controlled.copy()
    stopped[:] = False
    assert replace(gap, controlled=stopped).stretches(1) == []


def test_its_digest_is_that_of_the_numbers(recording):
    assert recording.digest() == replace(recording, source="elsewhere").digest()
    other = recording.torque_nm.copy()
    other[3, 3] = np.nextafter(other[3, 3], 1e9)
    assert recording.digest() != replace(recording, torque_nm=other).digest()
