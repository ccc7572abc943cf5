"""How a line is braked after a web break: on one ramp, within the brakes, and released where that would hurt."""

import tomllib
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.braking import brakes_of, braking_s, coasting_s, longest_braking_s
from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.core.signals import Inputs, Quality
from safety.actions import Action
from safety.braking import BrakingState, begin, brake, braking_limits
from safety.limits import envelope_limits

N, TOP_M_PER_S, BRAKE_NM, POWER_W, SET_N = 3, 8.0, 260.0, 4200.0, 100.0
INERTIA = np.array([2.0, 5.0, 76.0])
RADIUS = np.array([0.2, 0.2, 0.5])


def line_of(brakes=(True, True, True), energy_j=None, tolerance=0.2, friction_per_inertia=0.01, doubt=0.5) -> Line:
    """Three rollers that coast for minutes, the last a reel; `doubt` is the tolerance of their frictions."""
    document = tomllib.loads(line_template(N))
    document["limits"] |= {
        "torque_nm": 400.0, "torque_rate_nm_per_s": 8000.0, "tension_min_n": 10.0, "tension_max_n": 200.0,
        "speed_max_m_per_s": TOP_M_PER_S,
    }  # fmt: skip
    document["moves"] |= {"stop_rate_m_per_s2": 0.8}
    for i in range(N):
        document["rollers"][i] |= {
            "radius_m": {"value": float(RADIUS[i]), "tolerance": 0.01},
            "inertia_kg_m2": {"value": float(INERTIA[i]), "tolerance": tolerance},
            "friction_nms_per_rad": {"value": friction_per_inertia * float(INERTIA[i]), "tolerance": doubt},
        }
        if brakes[i]:
            document["drives"][i] |= {"braking_torque_nm": BRAKE_NM, "braking_power_w": POWER_W}
            document["drives"][i] |= {} if energy_j is None else {"braking_energy_j": energy_j}
    return Line.model_validate(document)


@dataclass
class Braked:
    """Rollers without web that obey eq. roller_velocity_dynamics, and what is decided of them, period by period."""

    line: Line = field(default_factory=line_of)
    speed_m_per_s: float = TOP_M_PER_S
    inertia_share: float = 1.0
    friction_per_inertia: float = 0.01
    sign: np.ndarray = field(default_factory=lambda: np.ones(N))

    def __post_init__(self):
        self.limits = braking_limits(self.line, envelope_limits(self.line))
        self.inputs = Inputs(N)
        self.v = np.full(N, self.speed_m_per_s)
        self.v0 = self.speed_m_per_s
        self.lost = np.zeros(N, np.bool_)
        self.tension = np.zeros(N)  # these rollers have no web
        self.torque = np.zeros(N)
        self.codes: list[tuple[str, Action]] = []
        self.seen: list[np.ndarray] = []
        self.state: BrakingState | None = None
        self.now_s = 0.0
        self.last = None

    def show(self):
        for i in range(N):
            self.inputs.tension.put(i, self.tension[i], self.now_s)
            self.inputs.speed.put(i, self.v[i], self.now_s)
        self.inputs.unwind_speed.put(0, self.v0, self.now_s)
        self.inputs.plc.quality = Quality.GOOD

    def period(self, hide=lambda inputs: None):
        self.show()
        hide(self.inputs)
        if self.state is None:
            self.state = begin(self.limits, self.inputs, self.speed_m_per_s, np.full(N, SET_N), self.lost)
        found = brake(self.limits, self.state, self.inputs, self.lost, self.torque)
        self.codes += [(finding.rule, finding.action) for finding in found.findings]
        self.torque = np.where(found.released, 0.0, found.torque_nm)
        inertia, radius = self.inertia_share * INERTIA, RADIUS
        rate = radius / inertia * self.sign * self.torque - self.friction_per_inertia * INERTIA * self.v / inertia
        self.v = self.v + rate * self.limits.period_s
        self.v0 = found.unwind_speed_m_per_s
        self.now_s += self.limits.period_s
        self.seen.append(self.v.copy())
        self.last = found
        return found

    def run(self, seconds, hide=lambda inputs: None):
        while self.now_s < seconds and not (self.last and self.last.over):
            self.period(hide)
        return self


@pytest.mark.parametrize("share", [0.82, 1.0, 1.18])
def test_a_reel_of_76_kg_m2_at_8_m_per_s_rests_within_10_s_and_never_turns_back(share):
    braked = Braked(inertia_share=share).run(12.0)
    assert braked.last.over and braked.now_s < 10.0
    speeds = np.array(braked.seen)
    assert (speeds > -1e-3 * TOP_M_PER_S).all() and (np.abs(speeds[-1]) <= braked.limits.rests_m_per_s).all()
    assert not braked.codes
    ramp = np.ptp(speeds[:400], axis=1)  # nothing pulls the web between them
    assert ramp.max() < 0.02 * TOP_M_PER_S


@given(
    st.lists(st.floats(-1.2 * TOP_M_PER_S, 1.2 * TOP_M_PER_S), min_size=N, max_size=N),
    st.floats(0.0, TOP_M_PER_S),
    st.lists(st.floats(0.0, 250.0), min_size=N, max_size=N),
)
def test_a_brake_gives_no_more_than_torque_and_power_and_drives_nothing_but_friction(speeds, request, tensions):
    braked = Braked(speed_m_per_s=request)
    braked.v, braked.tension = np.array(speeds), np.array(tensions)
    found = braked.period()
    pulled = np.append(np.maximum(braked.tension - SET_N, 0.0)[1:], 0.0)
    for torque, speed, radius, inertia, pull in zip(found.torque_nm, speeds, RADIUS, INERTIA, pulled, strict=True):
        if torque * speed < 0.0:
            assert abs(torque) <= BRAKE_NM and abs(torque * speed / radius) <= POWER_W * (1.0 + 1e-9)
        else:
            assert abs(torque) <= 0.01 * inertia * abs(speed) / radius + 0.5 * radius * pull + 1e-9


def test_a_ramp_does_not_stay_above_rollers_that_friction_slows_down():
    """Held up, those of little friction would be pulled at by the others. The unwinder goes along as it can."""
    line = line_of(friction_per_inertia=10.0, doubt=0.75)
    braked, asked = Braked(line, friction_per_inertia=17.5), [TOP_M_PER_S]
    while braked.now_s < 1.0:
        asked.append(braked.period().unwind_speed_m_per_s)
        assert braked.state.ramp_m_per_s[0] <= braked.state.speed_m_per_s.max() + 1e-9
    steepest = braked.limits.brakes.wanted_m_per_s2 * braked.limits.period_s
    assert -np.diff(asked) == pytest.approx(np.full(100, steepest))
    assert braked.run(12.0).last.over and braked.last.unwind_speed_m_per_s == 0.0


@pytest.mark.parametrize("share", [0.25, 1.0, 1.75])
def test_wherever_its_friction_is_in_its_tolerance_no_roller_is_driven_faster(share):
    """Rollers that friction stops sooner than the feedback of their speed answers, and that no web holds."""
    line = line_of(friction_per_inertia=10.0, doubt=0.75)
    braked = Braked(line, friction_per_inertia=10.0 * share).run(12.0)
    assert braked.last.over and braked.now_s < 10.0 and not braked.codes
    assert (np.diff(np.array(braked.seen), axis=0) <= 1e-9).all(), "slower in every period"
    assert np.array(braked.seen).min() > -1e-3 * TOP_M_PER_S


def test_a_roller_that_friction_would_stop_too_soon_is_driven_against_it_alone():
    line = line_of()
    heavy = line.rollers[0].model_copy(
        update={"friction_nms_per_rad": line.rollers[0].friction_nms_per_rad.model_copy(update={"value": 4.0})}
    )
    braked = Braked(line.model_copy(update={"rollers": [heavy, *line.rollers[1:]]}))
    braked.period()
    assert 0.0 < braked.torque[0] <= 4.0 * TOP_M_PER_S / RADIUS[0]


def test_a_drive_that_turns_the_wrong_way_is_let_go_at_once():
    braked = Braked(sign=np.array([1.0, 1.0, -1.0]))
    braked.tension[:] = 0.0  # that of rollers without web
    braked.run(1.0)
    assert braked.codes == [("brake-released-turns-backwards", Action.NONE)]
    assert braked.torque[2] == 0.0 and braked.seen[-1][2] < 1.1 * TOP_M_PER_S


def test_what_the_web_does_is_not_held_against_a_drive():
    braked = Braked()
    braked.tension = np.array([SET_N, 0.0, SET_N])
    while braked.now_s < 1.0:
        braked.period()
        braked.v[1] += RADIUS[1] ** 2 / INERTIA[1] * SET_N * braked.limits.period_s  # the span behind pulls it along
    assert not braked.codes


def test_drives_that_leave_and_speeds_that_are_lost_are_told_and_released():
    braked = Braked().run(0.2)
    braked.lost[0] = True
    braked.period()
    assert braked.codes == [("brake-released-drive-left", Action.NONE)] and braked.last.released.tolist() == [1, 0, 0]
    held = braked.torque.copy()
    blind = lambda inputs: inputs.speed.miss(2)  # noqa: E731
    braked.period(blind)
    assert braked.torque[2] == held[2] != 0.0
    braked.period(blind)
    braked.period(blind)
    assert braked.codes[1:] == [("brake-released-speed-unknown", Action.NONE)] and braked.torque[2] == 0.0


def test_a_dc_link_takes_what_it_takes():
    braked = Braked(line_of(energy_j=2000.0)).run(6.0)
    assert ("brake-released-energy-spent", Action.NONE) in braked.codes
    assert braked.last.released[2]


@pytest.mark.parametrize("hidden", ["unwind", "plc"])
def test_rollers_that_the_web_ties_to_an_unwinder_that_is_not_known_are_released(hidden):
    def hide(inputs):
        if hidden == "unwind":
            inputs.unwind_speed.miss(0)
        else:
            inputs.plc.quality = Quality.STALE

    braked = Braked().run(0.1)
    for _ in range(3):
        braked.period(hide)
    assert braked.last.released.all() and {code for code, _ in braked.codes} == {"brake-released-unwinder-unknown"}
    assert braked.last.over  # nothing is left to be braked


def broken(braked):
    """The rollers behind span 2 run ahead of those before it."""
    braked.v[1:] *= 1.1
    return braked


def test_behind_a_break_no_unwinder_is_needed():
    braked = broken(Braked())
    braked.period()
    for _ in range(5):
        braked.period(lambda inputs: inputs.unwind_speed.miss(0))
    assert braked.last.released.tolist() == [True, False, False]
    braked.run(12.0, lambda inputs: inputs.unwind_speed.miss(0))
    assert braked.last.over and (np.abs(braked.v[1:]) <= braked.limits.rests_m_per_s).all()


def test_a_reel_without_a_brake_is_not_pulled_at_by_what_the_web_ties_to_it():
    """Behind the break roller 2 brakes no more than the reel coasts; ahead of it the line is stopped as ever."""
    braked = broken(Braked(line_of(brakes=(True, True, False))))
    for _ in range(200):
        braked.period()
    assert braked.v[0] < TOP_M_PER_S - 1.0 and braked.v[1] > 0.95 * braked.v[2] > TOP_M_PER_S


def test_at_its_limit_a_span_is_not_pulled_at_at_all():
    braked = Braked().run(0.1)
    braked.tension[0] = braked.tension[2] = 201.0
    ramp = braked.state.ramp_m_per_s[0]
    braked.period()
    assert braked.torque[1] >= 0.0 > braked.torque[2]
    assert ramp - braked.state.ramp_m_per_s[0] == pytest.approx(
        0.2 * TOP_M_PER_S / 7.0 * 0.01
    )  # and the unwinder waits


def test_near_its_limit_a_span_is_not_pulled_at():
    near = Braked()
    near.tension[2] = 190.0
    near.run(0.1)
    assert abs(near.torque[1]) <= 0.21 * BRAKE_NM and near.torque[2] < 0.0


def test_a_broken_span_that_carries_again_is_braked_as_whole():
    braked = broken(Braked())
    braked.period()
    braked.tension[1] = 30.0
    braked.period()
    assert not braked.codes
    braked.period()
    assert braked.codes == [("broken-span-carries", Action.NONE)] and braked.state.broken_at == N
    assert not braked.last.released.any()


def test_slack_that_comes_back_on_one_ramp_is_nothing():
    braked = Braked().run(0.2)
    braked.tension[1] = 30.0
    braked.run(0.4)
    assert not braked.codes and not braked.last.released.any()


def test_a_break_found_later_begins_at_the_speed_of_the_heaviest():
    braked = Braked().run(0.5)
    before = float(braked.state.speed_m_per_s[2])
    broken(braked)
    braked.period()
    braked.period()
    assert braked.state.broken_at == 1 and braked.state.ramp_m_per_s[1] == pytest.approx(before, rel=0.05)


def test_speeds_that_were_never_known_are_taken_as_asked_for():
    braked = Braked()
    limits = braked.limits
    state = begin(limits, Inputs(N), 2.0, np.full(N, SET_N), braked.lost)
    assert state.speed_m_per_s.tolist() == [2.0] * N and state.unwind_speed_m_per_s == 2.0


def test_what_is_computed_ahead_of_a_break():
    brakes = brakes_of(line_of(brakes=(True, True, False)))
    assert brakes.braked.tolist() == [True, True, False]
    assert coasting_s(brakes)[2] == pytest.approx(76.0 * 1.2 / (0.01 * 76.0 * 0.5) * np.log(50.0))
    assert (braking_s(brakes_of(line_of())) < 10.0).all()
    assert longest_braking_s(line_of(brakes=(False, False, False))) == 0.0 < longest_braking_s(line_of()) <= 60.0
