"""What is wrong with a text that is no TOML, where, and what to do about it."""

import re

from gateway.core.line_problem import Problem, printable

_SYNTAX_PLACE = re.compile(r"(.*) \((?:at line (\d+), column (\d+)|at end of document)\)", re.DOTALL)

#: What to do about a syntax error, by what tomllib says.
_SYNTAX_ADVICE = {
    "Expected newline or end of document": "one key = value per line, a point in decimal numbers, text in quotes",
    "Cannot overwrite a value": "this key stands here for the second time: keep one",
    "Duplicate inline table key": "this key stands here for the second time: keep one",
    "twice": "this table stands here for the second time: put its keys under the first, "
    "or write [[...]] where there are several",
    "Cannot": "this table or key has been given already, in another way: keep one",
    "Invalid value": "write a number with a decimal point (0.5), text in quotes, true, false, [ ... ] or { ... }",
    "Unclosed array": "close the list with ] and put commas between its elements",
    "Unclosed inline table": "close the table with } on the same line and put commas between its keys",
    "Expected '=' after a key": "write key = value, or [table] for a table; decimal numbers take a point",
    "at the end of a": "close the brackets of the table's name",
    "Invalid initial character": "write a key of letters, digits, _ and -; inside { ... } all on one line",
    "Invalid statement": "write key = value or [table]; begin a comment with #",
    "Illegal character '\\n'": "close the text with a quote on the same line",
    "Unterminated string": "close the text with a quote",
    "Expected \"'": "close the text with a quote",
    "Unescaped": "write \\\\ for a backslash, or put the text in single quotes",
}


def syntax_problem(error: Exception, text: str, source: str) -> Problem:
    """What `tomllib.loads(text)` has raised, with its line; `source` is the file's name in messages."""
    if isinstance(error, RecursionError):
        return Problem(source, 1, "", "", "brackets are nested too deeply to be read")
    match = _SYNTAX_PLACE.fullmatch(str(error))
    if match is None:  # a number with thousands of digits: tomllib gives no place
        digits = re.search(r"\d{1000}", text)
        line = text.count("\n", 0, digits.start()) + 1 if digits else 1
        return Problem(source, line, "", "", "this number has too many digits to be read")
    what, line, column = match.groups()
    place = f"column {column}" if column else "at the end of the file"
    advice = next((advice for said, advice in _SYNTAX_ADVICE.items() if said in what), "see https://toml.io")
    line_number = int(line) if line else max(1, text.rstrip("\n").count("\n") + 1)
    return Problem(source, line_number, "", "", f"{place}: not TOML ({printable(what)}): {advice}")
