"""What each key of `line.toml` means, in one line: the comments of `init` and the descriptions of the JSON schema."""

from typing import Any

from gateway.core.line import Line

_DEVICE = {
    "name": "your name for the device, unique among all devices",
    "bus": "the [[buses]] entry that it is wired to",
    "map": "device type: which registers or objects mean what",
}
_PARAMETER = "nominal value, and how far the truth may lie from it"

_PROTOCOL = '"canopen", "modbus-tcp" or "opcua"'

#: By the name of the model in `line.py`, then by key.
HELP: dict[str, dict[str, str]] = {
    "Line": {
        "format": "version of this file format",
        "site": "first part of every address on the network",
        "line": "second part; unique within the site",
        "description": "for people",
        "control": "the loop's clock",
        "limits": "what must never be left; changed only here, by an engineer",
        "moves": "how set-points move, and how the line stops",
        "stages": "what a start goes through before the line runs",
        "web": "the material",
        "rollers": "the driven ones, in the direction of transport; the unwinder (roller 0) is not listed",
        "spans": "free lengths of web, in the direction of transport; span i ends at roller i",
        "buses": "the wires",
        "drives": "one per roller, torque-controlled",
        "load_cells": "one per tension-controlled span",
        "plc": "drives the unwinder, owns the permissive and the emergency stop",
        "history": "what the gateway keeps on disk; the oldest goes first",
        "priorities": "what matters on this line: the weights by which r2rgate design chooses among controllers",
        "gate": "what a change must show before it may reach a drive, and who decides",
        "agents": "who is asked where a phase leaves something to judgement; every change is judged all the same",
        "network": "lets agents on other machines in, by certificate (r2rgate pki init); without this table none is",
        "operator": "where people reach the line: an OPC UA server and a page (r2rgate operator)",
        "recipes": "set-points for a grade; the line starts with the first",
    },
    "Control": {
        "period_s": "one control cycle",
        "latency_s": "from a sample to the torque it causes; at least one period, torque acts with the next cycle",
        "cpu": "pin the loop to this processor; without this key: the last one",
        "priority": "real-time priority (SCHED_FIFO), where permitted",
    },
    "Limits": {
        "torque_nm": "per drive, in either direction",
        "torque_rate_nm_per_s": "fastest change of a torque command",
        "tension_min_n": "below it the web is slack: stop",
        "tension_max_n": "above it the web may tear: stop",
        "tension_margin_n": "set-points keep this far from both, so that noise does not stop the line",
        "speed_max_m_per_s": "fastest web speed",
        "tension_step_max_n": "largest set-point change made at once; larger ones are ramped",
        "steps_together": "times that, the steps of all spans within 2 s: the last roller's speed follows their sum",
        "speed_step_max_m_per_s": "the same for the speed",
        "hold_periods": "periods without a signal until the line is stopped",
        "watchdog_s": "the drives take torque off by themselves after this silence",
        "stuck_s": "a load cell that shows one value for so long, while rollers move, is stuck: stop",
        "tensioning_time_s": "after start every span must reach its tension within this time",
    },
    "Moves": {
        "shape": '"ramp", or "minimum-jerk": smooth, with feed-forward; the rates are then the greatest on the way',
        "tension_rate_n_per_s": "ramp of tension set-points",
        "speed_rate_m_per_s2": "ramp of the speed set-point",
        "stop_rate_m_per_s2": "ramp of a controlled stop",
        "stop_time_s": "torque goes off after this time in a stop, whatever the speed",
        "torque_off_rate_nm_per_s": "ramp of the torque to zero at the end of a stop",
        "brake_time_s": "after a web break: from the greatest speed to rest, as far as the drives can brake so fast",
    },
    "Stages": {
        "start_warning_s": "after start the line PLC's warning output is on for so long before anything moves",
        "tensioning": "until every span carries tension: small limits of their own, for a web that may not be there",
    },
    "Tensioning": {
        "roller_speed_max_m_per_s": "of a roller's surface, at most a tenth of limits.speed_max_m_per_s and 0.1 m/s; "
        "without this key: derived from line and web",
        "torque_share": "a roller's torque may be so much above what the tension that is asked for explains",
    },
    "Web": {
        "stiffness_n": "E A, modulus times cross-section",
        "tension_before_n": "tension ahead of span 1, as far as it acts on the rollers",
        "tension_after_n": "tension behind the last roller",
    },
    "Parameter": {
        "value": "nominal value",
        "tolerance": "how far the truth may lie from it, as a fraction: 0.3 means 30 % either way",
    },
    "Roller": {
        "name": "your name for the roller",
        "radius_m": _PARAMETER,
        "inertia_kg_m2": "roller, gear and motor, seen at the roller",
        "friction_nms_per_rad": "viscous friction",
        "torque_nm": "of its drive, in either direction; without this key limits.torque_nm, which is the widest",
    },
    "Span": {
        "name": "your name for the span",
        "length_m": "free web between the two rollers",
        "control": '"tension" needs a load cell; "draw" keeps a speed ratio and needs none',
        "slack_max_m": "web that may hang in it at a start; a span that shows no tension after it stops the line",
        "tension_min_n": "of this span; without this key limits.tension_min_n, which is the widest",
        "tension_max_n": "of this span; without this key limits.tension_max_n, which is the widest",
    },
    "CanopenBus": {
        "name": "your name for the bus",
        "protocol": _PROTOCOL,
        "interface": '"socketcan" for a CAN card, "udp_multicast" or "virtual" for the simulated line',
        "channel": 'socketcan: the network interface, e.g. "can0"; udp_multicast: the group\'s address',
        "port": "udp_multicast only",
        "bitrate_bit_per_s": "as set in the drives",
    },
    "ModbusTcpBus": {
        "name": "your name for the bus",
        "protocol": _PROTOCOL,
        "host": "address or name of the device or gateway",
        "port": "TCP port",
    },
    "OpcUaBus": {
        "name": "your name for the server",
        "protocol": _PROTOCOL,
        "endpoint": 'where the server listens, e.g. "opc.tcp://192.168.0.10:4840"',
        "security": '"none", or "Basic256Sha256": everything signed and encrypted, and nothing without',
        "certificate": "file with the gateway's certificate, .der or .pem; with security only",
        "private_key": "file with its private key, .der or .pem",
        "server_certificate": "file with the server's certificate, .der or .pem: no other server is talked to",
    },
    "Drive": {
        **_DEVICE,
        "address": "CANopen node, 1 to 127",
        "channel": "axis, of a device that moves several rollers",
        "roller": "which roller it drives, counted from 1",
        "direction": "forward, or reversed: a torque and a speed above 0 of its own turn the roller against transport",
        "gear": "turns of the motor for one of the roller; torques, and speeds in rpm or rad/s, are the motor's",
        "rated_torque_nm": "of the motor, as commissioned in the drive; commands are fractions of it",
        "braking_torque_nm": "after a web break the drive may brake with it; without it and a power the roller coasts",
        "braking_power_w": "that its DC link takes meanwhile: of its brake resistor, or fed back",
        "braking_energy_j": "that its brake resistor takes in one stop; without this key: any",
    },
    "LoadCell": {
        **_DEVICE,
        "address": "Modbus unit of the amplifier",
        "span": "which span it measures, counted from 1",
        "channel": "channel of the amplifier",
        "sign": "normal, or inverted: it shows less where the web pulls more",
        "capacity_n": "a reading beyond it is not believed",
    },
    "LinePlc": {
        **_DEVICE,
        "address": "Modbus unit",
        "speed_lag_s": "from a speed request to the unwinder's speed; without this key: one period",
    },
    "History": {
        "keep_days": "of telemetry: about 0.7 GB a day for six spans at 100 Hz",
        "keep_gb": "largest size, of telemetry and events together",
        "keep_events_days": "of events: state changes, commands, alarms",
    },
    "Priorities": {
        "rmse_per_n": "per N of tracking error",
        "settling_per_s": "per s of settling time",
        "overshoot_per_pct": "per % of overshoot",
        "effort_per_n2m2s": "per (Nm)2 s of torque, squared and integrated",
        "robustness_per_n": "per N by which the tension may differ where the model is wrong within its tolerances",
        "compute_per_s": "per s of computing in a control period",
    },
    "Gate": {
        "autonomy": '"approve-all": a person decides each change; "approve-first": the first of a kind; "closed": none',
        "approvals": "people that approve a change, where it takes a person; 2: two different ones",
        "small_share": "approve-first: what differs by no more from what a person approved last needs no person",
        "authors": "who may propose a change",
        "proposal_max_bytes": "largest proposal",
        "expiry_max_s": "longest time that a proposal stands",
        "cool_down_s": "from one change to the next",
        "verdict_max_s": "no verdict within this time is a refusal",
        "probation_s": "time under watch before a change is kept; it is rolled back by itself if nothing renews it",
        "innovation_low": "least normalised innovation squared of a valid model, on data that move; 1 is right",
        "innovation_high": "the greatest",
        "data_max_age_s": "data that a model is checked against are not older",
        "alignment_max_s": "a channel may tell late by no more, its interval included",
        "decay_min_per_s": "least decay of the slowest mode, whichever line the model leaves possible",
        "delay_margin_min_s": "least delay that a loop must stand beyond the measured latency",
        "corners": "simulated lines at the corners of what the model leaves open",
        "corner_sigmas": "standard deviations from the model to a corner",
        "corner_least": "of each parameter, either way, however sure the model is",
        "stress_torque_lag_s": "every simulated line has it: torque follows its command with this lag",
        "stress_late_share": "every simulated line has it: share of commands that come a period late",
        "stress_coulomb_nm": "every simulated line has it: dry friction of each roller",
        "stress_eccentricity": "every simulated line has it: of each roller, as a share of its radius",
        "tail_oscillation_max_n": "a tension that should stand may swing by no more",
        "tail_error_max_n": "a tension that should stand may be off by no more in the mean",
        "chatter_max_nm": "a torque may change by no more from period to period, root mean square",
        "tolerance_share": "of a metric, by which a change may be worse than what is in service",
        "tolerance_n": "the same of tracking errors, where that is more",
        "tolerance_settling_s": "the same of settling times",
        "tolerance_overshoot_pct": "the same of overshoot",
        "fine_overshoot_pct": "overshoot up to which none is worse than another",
        "first_speed_max_m_per_s": "fastest speed before a model is accepted",
        "first_step_max_n": "largest set-point step before a model is accepted",
        "first_corner_share": "of the tolerances: at its corners a first configuration and an experiment are simulated",
    },
    "Agents": {
        "llm": '"off": the rules decide; "ollama": a language model is asked first',
        "url": "where Ollama answers",
        "model": "its name there, with its tag",
        "temperature": "0: always the likeliest word; more: more varied",
        "seed": "of its choice of words",
        "context_tokens": "longest question with everything that goes with it; what is longer is refused",
        "answer_tokens": "longest answer",
        "answer_max_s": "for an answer with all its tries; after it the rules decide",
        "load_max_s": "for the model to be loaded",
        "task_max_tokens": "asked and answered in one commissioning; after it the rules decide",
        "computations_max": "simulations and the like that a model may ask for before it answers; 0: none",
        "embedder": 'what finds knowledge by meaning: "minilm", "ollama:MODEL"; "lexical": by words alone',
    },
    "Network": {
        "listen": 'where agents reach the gateway, e.g. "tls/192.168.0.5:7447"',
        "certificate": "file with the gateway's certificate, .pem",
        "private_key": "file with its private key, .pem",
        "authority": "file with the certificate of who signs the agents' certificates, .pem",
        "names": "common names of the certificates that may be agents; all others are refused",
    },
    "Operator": {
        "opc_ua": "where OPC UA clients reach the line, signed and encrypted only",
        "page": "where browsers do; beyond this machine https:// only",
        "anonymous": '"read": whoever has no name may look; "none": nobody',
        "pki": "folder with the certificates and the trusted ones; without this key: operator/pki of the line's data",
        "sessions_max": "OPC UA clients at once; of one address three quarters, at least 1",
        "nodesets": "folder with the OPC Foundation's node sets (DI, Machinery, ...); without this key: own types only",
    },
    "Recipe": {
        "name": "name of the grade",
        "tension_n": "one per span; for draw spans the tension that their speed ratio is computed from",
        "speed_m_per_s": "line speed",
    },
}


def line_schema() -> dict[str, Any]:
    """JSON schema of a line description (for editors), with the descriptions of HELP.

    It says what single values must satisfy; what several tables must satisfy together, `check` knows.
    """
    schema = Line.model_json_schema()
    for model, node in {"Line": schema, **schema["$defs"]}.items():
        for key, property_ in node["properties"].items():
            property_["description"] = HELP[model][key]
            property_.pop("title", None)  # it only repeats the key
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
