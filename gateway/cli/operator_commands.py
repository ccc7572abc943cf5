"""`r2rgate operator`: what people reach the line by."""

import typer

from gateway.cli.process_commands import (
    DataFolder,
    LineFile,
    RunFolder,
    begin_process,
    read_line,
    writable_folder,
)
from gateway.mailbox.paths import OPERATOR_DATA


def operator(file: LineFile, run_dir: RunFolder = None, data_dir: DataFolder = None) -> None:
    """The operator's process: an OPC UA server and a page, as the line's file has it in \\[operator].

    It shows the line and its proposals, and hands on what people say, with their names, to the gateway. Who may is in
    `r2rgate users`; whose clients may in `r2rgate pki trust`. The line runs on without it.

    Exit code: 0 ended as asked, 2 refused.

    Example: r2rgate operator line.toml
    """
    from gateway.operator.process import run_operator

    line = read_line(file)
    run_folder, data = begin_process(line, run_dir, data_dir)
    writable_folder(data / OPERATOR_DATA, "--data-dir")
    raise typer.Exit(run_operator(line, run_folder, data))
