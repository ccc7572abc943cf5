"""Components of the operator's page as reports embed them: its modules in one function, without imports and exports."""

import re

from gateway.cli.report.shell import static
from gateway.operator.page.words import words_of

MODULES = ("dom.js", "formats.js", "sentences.js", "figures.js")  #: each after those that it imports
OFFERED = ("h", "useWords", "beforeAfter", "margins")
FAMILIES = ("configuration.", "margin.", "measure.")  #: of the words that they say

_IMPORT = re.compile(r"^import .*\n", re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


def components() -> str:
    """A script that offers them as `components`."""
    modules = "".join(_EXPORT.sub("", _IMPORT.sub("", static(name))) for name in MODULES)
    return f"const components = (() => {{\n{modules}return {{ {', '.join(OFFERED)} }};\n}})();\n"


def component_words() -> dict[str, str]:
    """In English, as the rest of a report. What is in service on the page was so when it was judged."""
    said = words_of("en") | {"configuration.in service": "before"}
    return {key: text for key, text in said.items() if key.startswith(FAMILIES)}
