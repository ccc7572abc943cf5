"""A command that is not carried out."""


class Refused(Exception):
    """Nothing was changed. The text is one sentence; `reasons` has every one where there are several."""

    def __init__(self, text: str, reasons: list[str] | None = None) -> None:
        super().__init__(text)
        self.reasons = reasons or []
