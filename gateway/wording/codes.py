"""`python -m gateway.wording.codes`: docs/codes.md, made of the catalogues."""

from pathlib import Path

from gateway.wording.catalogue import ENGLISH, Entry, catalogue, fields, languages

PAGE = Path("docs/codes.md")


def codes_page() -> str:
    """Every code, what it says in English, its parameters, and in which languages there is a sentence."""
    lines = [
        "# Codes",
        "",
        "What is found, alarmed or refused, by its code. A code never changes its meaning; programs go by codes and "
        "parameters (SI, the unit in the name), people read sentences. Made by `python -m gateway.wording.codes`.",
        "",
        "| code | in English | what to do | parameters | languages |",
        "| --- | --- | --- | --- | --- |",
    ]
    for code, entry in sorted(catalogue(ENGLISH).entries.items()):
        said = [language for language in languages() if code in catalogue(language).entries]
        names = ", ".join(f"`{name}`" for name in sorted(_names(entry)))
        lines.append(f"| `{code}` | {_cell(entry.text)} | {_cell(entry.do)} | {names} | {', '.join(said)} |")
    return "\n".join(lines) + "\n"


def _names(entry: Entry) -> set[str]:
    return fields(entry.text) | fields(entry.do)


def _cell(text: str) -> str:
    return text.replace("|", "\\|") or "-"


if __name__ == "__main__":
    PAGE.write_text(codes_page(), encoding="utf-8")
