"""How a demonstration ends that cannot go on."""


class DemoFailed(Exception):
    """The text says why."""
