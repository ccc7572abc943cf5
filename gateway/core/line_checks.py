"""What the tables of a line description must satisfy together: a table of rules, one function each.

A rule runs when the tables that it reads are valid in themselves, so that one mistake hides as few others as
possible, and a rule that finds something stops no other.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from gateway.core import line_rules_agents as agents
from gateway.core import line_rules_braking as braking
from gateway.core import line_rules_estimate as estimate
from gateway.core import line_rules_network as network
from gateway.core import line_rules_operator as operator
from gateway.core import line_rules_process as process
from gateway.core import line_rules_wiring as wiring
from gateway.core.line import Line
from gateway.core.line_problem import Finding, Problem
from gateway.core.line_rules_wiring import Role

__all__ = ["RULES", "Role", "findings"]


@dataclass(frozen=True, slots=True)
class Rule:
    reads: frozenset[str]  #: the tables of the file that must be valid in themselves
    check: Callable[[Line], Iterable[Finding]]


def _rule(reads: str, check: Callable[[Line], Iterable[Finding]]) -> Rule:
    return Rule(frozenset(reads.split()), check)


_DEVICES = "drives load_cells plc"

RULES: tuple[Rule, ...] = (
    _rule("rollers spans", wiring.rollers_match_spans),
    _rule("rollers drives", wiring.one_drive_per_roller),
    _rule("spans load_cells", wiring.one_load_cell_per_span),
    _rule("rollers", partial(wiring.unique_names, "rollers")),
    _rule("spans", partial(wiring.unique_names, "spans")),
    _rule("buses", partial(wiring.unique_names, "buses")),
    _rule("recipes", partial(wiring.unique_names, "recipes")),
    _rule(_DEVICES, wiring.unique_device_names),
    _rule(f"buses {_DEVICES}", wiring.buses_exist),
    _rule(f"buses {_DEVICES}", wiring.buses_are_used),
    _rule("buses", wiring.buses_are_reachable),
    _rule(f"buses {_DEVICES}", wiring.canopen_addresses),
    _rule(f"control buses {_DEVICES}", wiring.can_buses_have_room),
    _rule("agents", agents.embedder_is_known),
    _rule("network", network.listens_with_tls),
    _rule("network", network.files_are_named),
    _rule("network", network.names_differ),
    _rule("operator", operator.opc_ua_is_an_endpoint),
    _rule("operator", operator.page_is_an_address),
    _rule("operator", operator.ports_differ),
    _rule("operator", operator.folders_are_absolute),
    _rule("limits", process.tension_limits_ordered),
    _rule("limits rollers spans", process.own_limits_within_common),
    _rule("limits web", process.web_bears_the_tension),
    _rule("limits", process.steps_within_limits),
    _rule("control", process.latency_is_possible),
    _rule("control limits", process.watchdog_outlasts_a_late_cycle),
    _rule("limits moves", process.stop_is_possible),
    _rule("limits rollers drives", process.drives_give_the_torque),
    _rule("limits rollers drives", braking.brakes_are_whole),
    _rule("drives", braking.one_resistor_is_given_once),
    _rule("limits moves rollers drives", braking.rollers_come_to_rest),
    _rule("limits web rollers spans load_cells gate recipes", estimate.estimates_are_bounds),
    _rule("limits web rollers spans load_cells gate recipes control", estimate.breaks_are_seen),
    _rule("limits load_cells", process.load_cells_see_the_tension),
    _rule("spans recipes", process.recipes_match_spans),
    _rule("limits spans recipes", process.recipes_within_tension),
    _rule("limits web recipes", process.recipes_within_speed),
    _rule("limits moves recipes", process.tensioning_in_time),
    _rule("limits stages", process.tensioning_is_slow),
    _rule("limits moves web spans", process.tensioning_keeps_the_speed),
    _rule("limits web rollers spans recipes", process.recipes_within_torque),
    _rule("limits web rollers spans recipes", process.speed_limit_within_torque),
)


def findings(
    line: Line,
    valid: set[str],
    known_maps: Mapping[str, Role] | None,
    unusable_maps: Mapping[str, Sequence[Problem]] | None = None,
) -> list[Finding]:
    """What all rules find in the tables of `line` that are `valid`; the others need not exist."""
    rules = [*RULES, _rule(_DEVICES, partial(wiring.addresses_differ, known_maps=known_maps))]
    if known_maps is not None:
        rules.append(
            _rule(
                f"buses {_DEVICES}", partial(wiring.maps_fit, known_maps=known_maps, unusable_maps=unusable_maps or {})
            )
        )
    return [finding for rule in rules if rule.reads <= valid for finding in rule.check(line)]
