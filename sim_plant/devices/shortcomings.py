"""In what a drive falls short of what it is told, though its state machine says that all is well."""

from dataclasses import dataclass


@dataclass(slots=True)
class Shortcomings:
    """None of them at first."""

    torque_share: float = 1.0  #: torque given per torque asked for
    direction: float = 1.0  #: -1: the motor is mounted the other way round, or geared so: it turns the roller backwards
    lost_to_mode: int | None = None  #: the mode of operation that it is in, whatever it is told
    says_follows: bool = False  #: and it says all the same that it follows its target torque
    unpowered: bool = False  #: its power stage has no supply
    warning: tuple[int, int] | None = None  #: error code and error register that it warns of
