"""The conditions under which control is compared: period, latency, limits, and how set-points move."""

from dataclasses import dataclass

from gateway.control.reference import MinimumJerk
from gateway.core.line import Line
from gateway.core.scenario import Scenario
from sim_plant.plant import Plant


@dataclass(frozen=True)
class Tier:
    name: str
    title: str
    period_s: float
    latency_s: float
    torque_nm: float
    torque_rate_nm_per_s: float
    move_s: float = 0.0  #: of the change, along a minimum-jerk curve; 0: a literal step
    speed_max_m_per_s: float = 0.0  #: in place of the line's; 0: as the line has it

    def scenario(self, scenario: Scenario) -> Scenario:
        """`scenario` as this tier moves."""
        return scenario.moved_over(self.move_s) if self.move_s else scenario

    def line(self, line: Line, scenario: Scenario) -> Line:
        """`line` under these conditions."""
        control = {"period_s": self.period_s, "latency_s": self.latency_s}
        limits = {"torque_nm": self.torque_nm, "torque_rate_nm_per_s": self.torque_rate_nm_per_s}
        if self.speed_max_m_per_s:
            limits["speed_max_m_per_s"] = self.speed_max_m_per_s
        moves: dict[str, object] = {}
        moved: dict[str, object] = {}
        if self.move_s:
            per_size = MinimumJerk.PEAK / self.move_s
            moves = {"shape": "minimum-jerk"}
            if scenario.tension_step_n:
                moves["tension_rate_n_per_s"] = per_size * scenario.tension_step_n
            if scenario.speed_step_m_per_s:
                moves["speed_rate_m_per_s2"] = per_size * scenario.speed_step_m_per_s
            # The speed is written a period later, and the unwinder's drive interpolates to it over another.
            moved = {"plc": line.plc.model_copy(update={"speed_lag_s": 2.0 * self.period_s})}
        return line.model_copy(
            update={
                **moved,
                "control": line.control.model_copy(update=control),
                "limits": line.limits.model_copy(update=limits),
                "moves": line.moves.model_copy(update=moves),
            }
        )

    def plant(self, plant: Plant) -> Plant:
        """`plant` with drives that give what this tier allows, and a recorder that judges by it."""
        drives = {"rated_torque_nm": self.torque_nm, "max_torque_nm": self.torque_nm}
        judged = {"torque_nm": self.torque_nm, "torque_rate_nm_per_s": self.torque_rate_nm_per_s}
        return plant.model_copy(
            update={
                "drives": plant.drives.model_copy(update=drives),
                "recorder": plant.recorder.model_copy(update=judged),
                "plc": plant.plc.model_copy(update={"speed_interpolation_s": self.period_s if self.move_s else 0.0}),
            }
        )


# A step of 24 N in 35 ms, as 500 Nm can, takes rollers at up to 0.5 m/s: a line for 0.12 m/s takes it for a broken web.
PAPER = Tier("P", "1 ms, no latency, literal step, 500 Nm", 0.001, 0.0, 500.0, 1e5, speed_max_m_per_s=0.5)
A = Tier("A", "10 ms and 10 ms latency, literal step, 60 Nm", 0.010, 0.010, 60.0, 1000.0)
A_FAST = Tier("A-fast", "2 ms and 4 ms latency, literal step, 60 Nm", 0.002, 0.004, 60.0, 1000.0)
B = Tier("B", "10 ms and 10 ms latency, 0.5 s minimum-jerk move, 60 Nm", 0.010, 0.010, 60.0, 1000.0, 0.5)
TIERS = {tier.name: tier for tier in (PAPER, A, A_FAST, B)}
