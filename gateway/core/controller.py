"""Controller configurations phi as data that can be stored, hashed and compared."""

import hashlib
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from gateway.core.canonical import canonical_bytes
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig
from gateway.core.finding import Finding

Controller = LinearConfig | MpcConfig | ScheduledConfig
ControllerConfig = Annotated[Controller, Field(discriminator="kind")]
_adapter: TypeAdapter[Controller] = TypeAdapter(ControllerConfig)


class ControllerRefused(Exception):
    """A configuration that must not be used; the text names every reason, `findings` those that are data."""

    def __init__(self, text: str, findings: Sequence[Finding] = ()) -> None:
        super().__init__(text)
        self.findings = list(findings)


def canonical(config: Controller) -> bytes:
    """The one byte representation of a configuration, the same whoever writes it."""
    return canonical_bytes(config)


def config_hash(config: Controller) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(config)).hexdigest()


def parse_controller(payload: bytes) -> Controller:
    """The configuration in `payload` (JSON). Raises ControllerRefused with every reason."""
    try:
        return _adapter.validate_json(payload)
    except ValidationError as error:
        raise ControllerRefused("; ".join(map(_reason, error.errors()))) from error


def _reason(error: ErrorDetails) -> str:
    place = ".".join(map(str, error["loc"]))  # empty for text that is no JSON at all
    return f"{place}: {error['msg']}" if place else error["msg"]
