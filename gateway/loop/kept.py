"""What outlives the loop: the last known good configuration, in one file, all of it or the one before.

Beside it the predictive one that was kept on top of it, if one was (see `configurations`). Never the one on probation:
a loop that starts anew starts with what was kept. The file belongs to the configuration that the loop is started with:
an engineer who gives it another one gets that.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from gateway.core.controller import Controller, ControllerConfig, canonical, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.deployment import Hash, RecoveryPrediction, Region
from gateway.core.line import Line, Strict

FILE = "configuration.json"
GIVEN = "started-with.json"  #: what the loop was given, for the gateway: its messages name configurations by hash


class OnTop(Strict):
    """A predictive configuration that was kept: it controls the line, and is not what the line goes back to."""

    controller: ControllerConfig
    region: Region


class Kept(Strict):
    format: Annotated[int, Field(ge=1, le=1)] = 1
    started_with: Hash  #: the configuration that the loop was given
    epoch: Annotated[int, Field(ge=0)]  #: the last that was taken, whatever became of it
    controller: ControllerConfig
    region: Region
    watch: RecoveryPrediction | None
    on_top: OnTop | None = None


class Store:
    """The file in `folder`, for a loop that was started with `config`."""

    def __init__(self, folder: Path, config: Controller) -> None:
        self.path = folder / FILE
        self._started_with = config_hash(config)

    def read(self, line: Line, say: Callable[[str], None]) -> Kept | None:
        """What was kept, or None: then the loop runs what it is given. A file that is not used is told, with why."""
        try:
            kept = Kept.model_validate_json(self.path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            reason = str(error).partition("\n")[0]
            say(f"{self.path} is not used, the configuration given is: {reason}")
            return None
        if kept.started_with != self._started_with:
            say(f"{self.path} belongs to another configuration than the one given, which is used")
            return None
        on_top = [] if kept.on_top is None else misfits(kept.on_top.controller, line)
        if reasons := [*misfits(kept.controller, line), *on_top]:
            say(f"{self.path} is not used, the configuration given is: {'; '.join(reasons)}")
            return None
        return kept

    def write_given(self, config: Controller) -> None:
        """Before the first period. Raises OSError."""
        self._write(self.path.with_name(GIVEN), canonical(config))

    def write(
        self, epoch: int, config: Controller, region: Region, watch: RecoveryPrediction | None,
        on_top: OnTop | None = None,
    ) -> None:  # fmt: skip
        """On the disk when it returns. Raises OSError; the file before is then as it was."""
        kept = Kept(
            started_with=self._started_with, epoch=epoch, controller=config, region=region, watch=watch, on_top=on_top
        )
        self._write(self.path, kept.model_dump_json().encode())

    def _write(self, path: Path, content: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(path.name + ".part")
        with beside.open("wb") as file:
            file.write(content + b"\n")
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
