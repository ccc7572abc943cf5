"""What was asked of the agents in the demonstration."""

from gateway.cli.asked_result import interactions_in
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_line import Setup
from gateway.core.interactions import Interaction
from gateway.supervisor.interactions import InteractionsError


def read_interactions(setup: Setup) -> list[Interaction]:
    """The oldest first. Raises DemoFailed where the log cannot be read; without one nothing was asked."""
    try:
        return interactions_in(setup.gateway_data)
    except InteractionsError as error:
        raise DemoFailed(str(error)) from error
