"""From a controller configuration to a law that runs."""

from typing import Any

from gateway.control.law import Law
from gateway.control.lqi import Lqi
from gateway.control.pid import Pid
from gateway.core.controller import LqiConfig, PidConfig


def make_law(config: LqiConfig | PidConfig) -> Law[Any]:
    """The law that `config` describes."""
    match config:
        case LqiConfig():
            return Lqi(config)
        case PidConfig():
            return Pid(config)
