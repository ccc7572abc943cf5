"""The commented line description that `init` writes: a demonstration line, valid as it is, to be filled in."""

import json

from gateway.core.line import Agents, Gate, Operator
from gateway.core.line_help import HELP
from gateway.core.line_template_tables import entries, parameter, table, tables
from gateway.core.line_template_wiring import DEMONSTRATION, Wiring, wired_tables

_TENSION_N = (28, 36, 20, 40, 24, 32)
MOST_SPANS = 60

_HEAD = """\
# Line description for r2rgate. SI units throughout; every unit is in the key's name.
# Fill in what differs on your line, then: r2rgate check {out}
#
#   unwinder ~~span 1~~ roller 1{more}
#
# Rollers and spans are numbered by their order in this file. Span i lies between roller i-1 and roller i; roller 0
# is the unwinder: the line PLC drives it, and it is not listed.
"""


def line_template(spans: int = 6, out: str = "line.toml", wiring: Wiring = DEMONSTRATION) -> str:
    """The text of a valid line description with `spans` spans, 1 to 60; `out` is the file's name in its comments.

    Raises ValueError for another number of spans, or more than the rack carries.
    """
    if not 1 <= spans <= MOST_SPANS:
        raise ValueError(f"a line has 1 to {MOST_SPANS} spans, not {spans}")
    more = {1: "", 2: " ~~span 2~~ roller 2"}.get(spans, f" ~~span 2~~ ... ~~span {spans}~~ roller {spans}")
    parts = [_HEAD.format(more=more, out=out), _line(spans), _process(spans), _web()]
    parts += [_rollers(spans), _spans(spans), *wired_tables(wiring, spans)]
    return "\n".join([*parts, _history(), _priorities(), _gate(), _agents(), _network(), _operator(), _recipes(spans)])


def _line(spans: int) -> str:
    description = f'"Demonstration line with {spans} span{"s" if spans > 1 else ""}, simulated"'
    return entries("Line", {"format": "1", "site": '"demo"', "line": '"line-1"', "description": description})


def _process(spans: int) -> str:
    # Tensioning all spans at once pulls the last roller at rate * sum(L) / (E A): at most half the greatest speed.
    tension_rate = min(20.0, 0.5 * 0.12 * 2400.0 / spans)
    control = {"period_s": "0.010", "latency_s": "0.010", "cpu": "#1", "priority": "60"}
    limits = {
        "torque_nm": "60.0",
        "torque_rate_nm_per_s": "1000.0",
        "tension_min_n": "2.0",
        "tension_max_n": "60.0",
        "tension_margin_n": "1.0",
        "speed_max_m_per_s": "0.12",
        "tension_step_max_n": "24.0",
        "steps_together": "4.0",
        "speed_step_max_m_per_s": "0.09",
        "hold_periods": "3",
        "watchdog_s": "0.1",
        "stuck_s": "0.9",
        "tensioning_time_s": "20.0" if spans <= 20 else "40.0",
    }
    moves = {
        "shape": '"minimum-jerk"',
        "tension_rate_n_per_s": f"{tension_rate:.1f}",
        "speed_rate_m_per_s2": "0.05",
        "stop_rate_m_per_s2": "0.1",
        "stop_time_s": "10.0",
        "torque_off_rate_nm_per_s": "200.0",
        "brake_time_s": "7.0",
    }
    tables = [table("control", "Control", control), table("limits", "Limits", limits)]
    return "\n".join([*tables, table("moves", "Moves", moves), _stages()])


def _stages() -> str:
    stages = entries("Stages", {"start_warning_s": "3.0"})
    tensioning = entries("Tensioning", {"roller_speed_max_m_per_s": "#0.01", "torque_share": "0.5"})
    heads = f"[stages]  # {HELP['Line']['stages']}\n", f"[stages.tensioning]  # {HELP['Stages']['tensioning']}\n"
    return f"{heads[0]}{stages}\n{heads[1]}{tensioning}"


def _web() -> str:
    parameters = (
        "# Physical parameters carry a tolerance, the fraction by which the truth may lie from the value either way.\n"
        "# Be honest: a wide tolerance costs little, a truth outside of it much. Identification narrows it later.\n"
    )
    web = {"stiffness_n": parameter("2400.0", "0.3"), "tension_before_n": "0.0", "tension_after_n": "0.0"}
    return parameters + table("web", "Web", web)


def _rollers(spans: int) -> str:
    return tables(
        "rollers",
        "Roller",
        [
            {
                "name": f'"roller-{i}"',
                "radius_m": parameter("0.04", "0.2"),
                "inertia_kg_m2": parameter("0.95", "0.3"),
                "friction_nms_per_rad": parameter("10.0", "0.75"),
                **({"torque_nm": "#40.0"} if i == 1 else {}),
            }
            for i in range(1, spans + 1)
        ],
    )


def _spans(spans: int) -> str:
    return tables(
        "spans",
        "Span",
        [
            {
                "name": f'"span-{i}"',
                "length_m": parameter("1.0", "0.3"),
                "control": '"tension"',
                "slack_max_m": "0.2",
                **({"tension_min_n": "#5.0", "tension_max_n": "#50.0"} if i == 1 else {}),
            }
            for i in range(1, spans + 1)
        ],
    )


def _history() -> str:
    return table("history", "History", {"keep_days": "90.0", "keep_gb": "20.0", "keep_events_days": "3650.0"})


def _priorities() -> str:
    values = {
        "rmse_per_n": "1.0",
        "settling_per_s": "0.2",
        "overshoot_per_pct": "0.01",
        "effort_per_n2m2s": "1e-5",
        "robustness_per_n": "0.1",
        "compute_per_s": "100.0",
    }
    return table("priorities", "Priorities", values)


def _gate() -> str:
    """Who decides stands open; the thresholds are there to be found, commented out at their defaults."""
    thresholds = {key: value for key, value in Gate().model_dump(mode="json").items() if key != "autonomy"}
    return table(
        "gate", "Gate", {"autonomy": '"approve-all"', **{k: f"#{json.dumps(v)}" for k, v in thresholds.items()}}
    )


def _agents() -> str:
    settings = {key: value for key, value in Agents().model_dump(mode="json").items() if key != "llm"}
    return table("agents", "Agents", {"llm": '"off"', **{k: f"#{json.dumps(v)}" for k, v in settings.items()}})


def _network() -> str:
    """Commented out: what nobody asks for is not listened on."""
    folder = "/etc/r2rgate/pki"
    settings = {
        "listen": '#"tls/192.168.0.5:7447"',
        "certificate": f'#"{folder}/gateway.pem"',
        "private_key": f'#"{folder}/gateway.key.pem"',
        "authority": f'#"{folder}/authority.pem"',
        "names": '#["agents"]',
    }
    return "# " + table("network", "Network", settings)


def _operator() -> str:
    settings = Operator(pki="/etc/r2rgate/pki", nodesets="/etc/r2rgate/nodesets").model_dump(mode="json")
    return table("operator", "Operator", {key: f"#{json.dumps(value)}" for key, value in settings.items()})


def _recipes(spans: int) -> str:
    tension_n = ", ".join(f"{_TENSION_N[i % len(_TENSION_N)]:.1f}" for i in range(spans))
    level_n = ", ".join(["30.0"] * spans)
    return tables(
        "recipes",
        "Recipe",
        [
            {"name": '"tension"', "tension_n": f"[{tension_n}]", "speed_m_per_s": "0.01"},
            {"name": '"velocity"', "tension_n": f"[{level_n}]", "speed_m_per_s": "0.01"},
        ],
    )
