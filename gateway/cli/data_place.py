"""In which folder the data of a line lie, where it is named, or where it is the only one."""

from pathlib import Path

from gateway.cli.process_commands import data_base, default_data_folder
from gateway.core.line import Line


def data_folder(line: Line | None, pattern: str, things: str, advice: str, error: type[Exception]) -> Path:
    """That of `line`; without one the only folder that holds a file like `pattern`. Raises `error`."""
    if line is not None:
        return default_data_folder(line)
    found = sorted({path.parent for path in data_base().glob(f"*/{pattern}")})
    if len(found) == 1:
        return found[0]
    if found:
        listed = "\n".join(f"  --data-dir {path}" for path in found)
        raise error(f"{len(found)} lines have {things} here; say which with --line LINE.toml, or:\n{listed}")
    raise error(
        f"there are no {things} in {data_base()}: {advice}; --line LINE.toml or --data-dir FOLDER says where else"
    )
