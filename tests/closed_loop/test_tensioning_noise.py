"""A fast line with noisy encoders is tensioned: its rollers turn slower than what they show shakes."""

import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.messages import Confirmed, Start
from gateway.core.states import Phase
from gateway.core.theta import expected_noise
from safety.tensioning import longest_tensioning_s, tensioning_speed_m_per_s
from tests.support.reel_line import reel_line, reel_plant

STIFF_N = 4e5


def started(stiffness_n: float, noise_m_per_s: float) -> SteppedLoop:
    """The reel line with another web, to the end of its tensioning."""
    line, plant = reel_line(), reel_plant()
    web = line.web.model_copy(update={"stiffness_n": line.web.stiffness_n.model_copy(update={"value": stiffness_n})})
    line = line.model_copy(update={"web": web})
    truth = {
        "web": plant.web.model_copy(update={"stiffness_n": stiffness_n}),
        "sensors": plant.sensors.model_copy(update={"speed_noise_m_per_s": noise_m_per_s}),
    }
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant.model_copy(update=truth), seed=1)
    loop.step(5)
    # By a person: what is tried here is what encoders show, not what so stiff a web makes of a first configuration.
    assert loop.command(Confirmed(configuration=loop.cycle.configurations.running.hash)).ok
    assert loop.arm().ok
    loop.step(100)
    assert loop.command(Start()).ok
    for _ in range(round((longest_tensioning_s(line) + 10.0) / line.control.period_s)):
        loop.step()
        if loop.cycle.machine.phase in (Phase.RUNNING, Phase.OFF):
            break
    return loop


@pytest.mark.parametrize("stiffness_n", [4e4, STIFF_N])
def test_a_fast_line_with_noisy_encoders_is_tensioned(stiffness_n: float) -> None:
    noise_m_per_s = 0.3 * expected_noise(reel_line()).speed_m_per_s
    loop = started(stiffness_n, noise_m_per_s)
    assert loop.cycle.machine.phase is Phase.RUNNING, loop.cycle.machine.reason


def test_no_noise_of_an_encoder_takes_torque_off() -> None:
    """A web that is so stiff that it is taken up slower than the encoders shake."""
    noise_m_per_s = expected_noise(reel_line()).speed_m_per_s
    loop = started(1e6, noise_m_per_s)
    assert tensioning_speed_m_per_s(loop.line) < noise_m_per_s
    assert "roller-speed" not in {one.rule for _, one in loop.stopped_by}, (
        "its tension is restless, and that is what is told"
    )
