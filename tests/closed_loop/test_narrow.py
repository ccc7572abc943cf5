"""A line that has changed: what runs, and what it would go back to, goes no further than a first configuration."""

from gateway.core.deployment import Region, first_region
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.messages import Keep, Narrow, Renew, Rollback, RunExperiment, SetSpeed, SetTension
from gateway.core.theta import nominal_theta
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.test_deploy import CANDIDATE, GOOD, LINE, deployment, in_service, producing

FIRST = first_region(LINE)
EXPERIMENT = Experiment(
    format=1, amplitude_n=[1.0] * LINE.n, dwell_s=0.1, legs=[Leg(duration_s=2.0)], abort=Abort(deviation_n=10.0)
)
WIDE = Region(speed_max_m_per_s=0.1, tension_step_max_n=20.0, speed_step_max_m_per_s=0.09)


def adapted(speed_m_per_s: float):
    """A line on which another configuration was kept, judged for more, with a model that watches it."""
    loop = producing(speed_m_per_s=speed_m_per_s)
    watch = recovery_prediction(nominal_theta(LINE), GOOD, LINE, [0.01, 0.1])
    assert loop.command(deployment(region=WIDE, watch=watch)).ok
    loop.step(50)
    assert loop.command(Renew(epoch=1)).ok
    kept = recovery_prediction(nominal_theta(LINE), CANDIDATE, LINE, [0.01, 0.1])
    assert loop.command(Keep(epoch=1, watch=kept)).ok
    return loop


def test_it_is_refused_while_the_line_shall_run_faster_and_says_how_to_go_on():
    loop = adapted(0.05)
    reply = loop.command(Narrow(region=FIRST))
    assert not reply.ok and [one.code for one in reply.findings] == ["line-too-fast"]
    assert reply.findings[0].parameters["allowed_m_per_s"] == FIRST.speed_max_m_per_s
    assert in_service(loop).region == WIDE and in_service(loop).watched


def test_what_nobody_explains_is_slowed_down_and_confined_on_a_line_that_runs_faster():
    loop = adapted(0.05)
    assert loop.command(Narrow(region=FIRST, confine=True)).ok
    found, setpoints = in_service(loop), loop.cycle.setpoints
    assert found.region == FIRST and not found.watched and loop.cycle.configurations.good.region == FIRST
    assert setpoints.speed_target_m_per_s == FIRST.speed_max_m_per_s and setpoints.speed_m_per_s > 0.04  # on its ramp
    loop.step(round(0.2 / LINE.moves.speed_rate_m_per_s2 / LINE.control.period_s))
    assert setpoints.speed_m_per_s == FIRST.speed_max_m_per_s
    assert not loop.command(SetSpeed(speed_m_per_s=0.05)).ok
    assert loop.truth.recorder.unsafe_total == 0 and not loop.transitions


def test_an_experiment_ends_where_nobody_explains_what_controls_the_line():
    loop = adapted(0.01)
    assert loop.command(RunExperiment(experiment=EXPERIMENT, proposal="a" * 64)).ok
    assert not loop.command(Narrow(region=FIRST)).ok and loop.cycle.experiments.run is not None
    assert loop.command(Narrow(region=FIRST, confine=True)).ok
    assert loop.cycle.experiments.run is None and in_service(loop).region == FIRST


def test_speeds_and_steps_beyond_are_refused_from_then_on_and_nothing_is_predicted():
    loop = adapted(0.01)
    assert loop.command(Narrow(region=FIRST)).ok
    found = in_service(loop)
    assert found.region == FIRST and not found.watched
    reply = loop.command(SetSpeed(speed_m_per_s=0.05))
    assert not reply.ok and "0.02 m/s" in reply.text
    step_n = (FIRST.tension_step_max_n or 0.0) + 1.0
    now_n = loop.cycle.setpoints.tension_target_n[2]
    assert not loop.command(SetTension(span=3, tension_n=now_n + step_n, step=True)).ok
    loop.command(Rollback(reason="a test"))
    assert in_service(loop).region == FIRST  # the way back goes no further either
    assert loop.command(SetSpeed(speed_m_per_s=0.02)).ok
    loop.step(200)
    assert loop.truth.recorder.unsafe_total == 0 and not loop.transitions


def test_not_while_something_is_on_probation():
    loop = producing(speed_m_per_s=0.01)
    assert loop.command(deployment(region=WIDE)).ok
    reply = loop.command(Narrow(region=FIRST))
    assert not reply.ok and [one.code for one in reply.findings] == ["on-probation"]


def test_it_only_ever_goes_less_far():
    narrow = Region(speed_max_m_per_s=0.005)
    assert FIRST.no_further(narrow).speed_max_m_per_s == 0.005 and FIRST.no_further(Region()) == FIRST
    assert Region().no_further(FIRST) == FIRST and FIRST.no_further(WIDE).within(WIDE)
