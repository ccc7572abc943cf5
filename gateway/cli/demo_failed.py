"""How a demonstration ends that cannot go on."""


class DemoFailed(Exception):
    """The text says why."""


class FolderInUse(Exception):
    """Another demonstration writes there; the text says what to do."""
