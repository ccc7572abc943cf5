"""In which folder the data of a line lie, where it is named, or where it is the only one."""

from collections.abc import Iterator
from pathlib import Path
from typing import cast

from gateway.cli.process_commands import data_base, default_data_folder, require_a_folder_a_process
from gateway.core.line import Line
from gateway.mailbox.paths import GATEWAY_DATA, OPERATOR_DATA


def gateway_data(
    line: Line | None, data_dir: Path | None, pattern: str, things: str, advice: str, error: type[Exception]
) -> Path:
    """`gateway_folder`; without `data_dir` and `line` the only one that holds a file like `pattern`. Raises `error`."""
    if data_dir is not None or line is not None:
        return gateway_folder(line, data_dir)
    found = sorted({path.parent for path in data_base().glob(f"*/{GATEWAY_DATA}/{pattern}")})
    if len(found) == 1:
        return found[0]
    if found:
        listed = "\n".join(f"  --data-dir {path.parent}" for path in found)
        raise error(f"{len(found)} lines have {things} here; say which with --line LINE.toml, or:\n{listed}")
    raise error(
        f"there are no {things} in {data_base()}: {advice}; --line LINE.toml or --data-dir FOLDER says where else"
    )


def gateway_folder(line: Line | None, data_dir: Path | None) -> Path:
    """The gateway's, of the line whose data lie in `data_dir`, else of `line`; one of both is given.

    `data_dir` may be such a folder itself: an audit that was moved aside is named so, and a copy.
    """
    data = data_dir or default_data_folder(cast(Line, line))
    if data_dir is None or (data / GATEWAY_DATA).is_dir() or not any(_of_gateway(data)):
        return own_folder(data, GATEWAY_DATA)
    require_a_folder_a_process(data, gateways_too=False)
    return data


def operator_folder(line: Line, data_dir: Path | None) -> Path:
    """The operator's: users and certificates."""
    return own_folder(data_dir or default_data_folder(line), OPERATOR_DATA)


def own_folder(data: Path, process: str) -> Path:
    """Of a process in a line's data; those of an earlier version, all in one folder, are refused."""
    require_a_folder_a_process(data)
    return data / process


def _of_gateway(folder: Path) -> Iterator[Path]:
    for pattern in ("*.sqlite", "audit.*"):
        yield from folder.glob(pattern)
