"""Tables of the line template as text: keys with their help as comments."""

from gateway.core.line_help import HELP

_COMMENT_COLUMN = 38


def entries(model: str, values: dict[str, str]) -> str:
    """`key = value  # help` for every key; a value that begins with # comments its key out."""
    lines: list[str] = []
    for key, value in values.items():
        entry = f"# {key} = {value[1:]}" if value.startswith("#") else f"{key} = {value}"
        lines.append(f"{entry:<{_COMMENT_COLUMN}}  # {HELP[model][key]}\n")
    return "".join(lines)


def _plain(values: dict[str, str]) -> str:
    return "".join(f"{key} = {value}\n" for key, value in values.items())


def table(key: str, model: str, values: dict[str, str]) -> str:
    return f"[{key}]  # {HELP['Line'][key]}\n{entries(model, values)}"


def tables(key: str, model: str, rows: list[dict[str, str]]) -> str:
    """An array of tables under its heading."""
    return heading(key) + array(key, model, rows)


def heading(key: str) -> str:
    return f"# {key.replace('_', ' ').capitalize()}: {HELP['Line'][key]}.\n"


def array(key: str, model: str, rows: list[dict[str, str]]) -> str:
    """An array of tables: the first with the help to every key, the others bare."""
    first, *others = rows
    return f"[[{key}]]\n{entries(model, first)}" + "".join(f"\n[[{key}]]\n{_plain(row)}" for row in others)


def parameter(value: str, tolerance: str) -> str:
    return f"{{ value = {value}, tolerance = {tolerance} }}"
