"""Text that speaks to a language model rather than to people. Pure.

What a document or a name says is data: nothing of it is followed, whatever it says. But whoever reads it, a person or a
model, is told where it tries, and sees it as a quotation. No list of patterns is complete: what protects the line is
that a proposal is judged and approved whatever it was that suggested it.
"""

import re
from dataclasses import dataclass

MOST_SHOWN = 160  #: letters of a passage
MOST_FLAGS = 20  #: of a text; more tell nothing more


@dataclass(frozen=True)
class Flag:
    kind: str  #: in words: "asks to forget what was said before"
    passage: str  #: as it stands there, cut


def _any(*patterns: str) -> re.Pattern[str]:
    return re.compile("|".join(f"(?:{pattern})" for pattern in patterns), re.IGNORECASE | re.MULTILINE)


_EARLIER = r"(?:previous|prior|above|earlier|preceding|foregoing|all|any|your|system|these)"
_ORDERS = r"(?:instructions?|prompts?|rules?|guidelines|messages?|directions|constraints)"
_KINDS: tuple[tuple[str, re.Pattern[str]], ...] = (
    (
        "asks to forget what was said before",
        _any(
            rf"\b(?:ignore|disregard|forget|override|bypass)\b[^.\n]{{0,30}}\b{_EARLIER}\b[^.\n]{{0,30}}\b{_ORDERS}\b"
        ),
    ),
    (
        "orders its reader to let something through",
        _any(
            r"\b(?:you|the (?:agent|assistant|model|ai))\s+(?:must|shall|should|have to|will|are to)\s+"
            r"(?:now\s+|always\s+)?(?:approve|accept|deploy|authori[sz]e|confirm|ignore|skip|disable|bypass|propose|answer|reply|output|choose|select|pick)"
            r"\b",
            r"\b(?:skip|bypass|disable|turn off|switch off)\s+(?:the\s+|all\s+|any\s+)?"
            r"(?:safety (?:filter|gate|check)s?|gate|judge|validation|verdicts?)\b",
        ),
    ),
    (
        "says what its reader is",
        _any(
            r"\byou are (?:now |actually )?(?:an? |the )?(?:ai|assistant|language model|llm|chatbot|agent|expert)\b",
            r"\b(?:pretend|act) (?:to be|as(?: if)?) ",
            r"\bas an? (?:ai|language model|assistant)\b",
            r"\b(?:new|updated|real|hidden) (?:system )?(?:prompt|instructions)\b",
        ),
    ),
    (
        "poses as a turn of a conversation",
        _any(
            r"<\|[a-z_ ]{2,40}\|>",
            r"\[/?INST\]",
            r"<</?SYS>>",
            r"<(?:start_of_turn|end_of_turn|bos|eos)>|</?s>",
            r"^\W{0,6}(?:system|assistant|user|human|developer)\W{0,4}:",
            r"^#{1,6}\s*(?:system|assistant|instruction|response)\b",
        ),
    ),
    (
        "has the form of a call of a tool",
        _any(
            r"</?(?:tool_call|tool_response|function_call|function|tools?|invoke|think)\b[^>\n]{0,60}>",
            r"[\"'](?:tool_calls?|function_call|tool_name)[\"']\s*:",
            r"\{\s*[\"']name[\"']\s*:\s*[\"'][^\"'\n]{1,60}[\"']\s*,\s*[\"'](?:arguments|parameters)[\"']\s*:",
        ),
    ),
    (
        "has letters that are not to be seen",
        re.compile("[\u200b-\u200f\u202a-\u202e\u2060-\u2064\u2066-\u2069\ufeff\U000e0000-\U000e007f]"),
    ),
)
_UNPRINTED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff\U000e0000-\U000e007f]"
)


def flags_in(text: str) -> list[Flag]:
    """What in `text` - of a document, or a name - speaks to a language model; empty: nothing that is known of."""
    found = [Flag(kind, _shown(text, match)) for kind, pattern in _KINDS for match in pattern.finditer(text)]
    return found[:MOST_FLAGS]


def quoted(text: str) -> str:
    """As it is put before a model or a person: no line of it can be taken for one of ours, no letter is hidden."""
    visible = _UNPRINTED.sub("\N{REPLACEMENT CHARACTER}", text.replace("\r\n", "\n").replace("\r", "\n"))
    return "\n".join(f"> {line}" for line in visible.split("\n"))


def _shown(text: str, match: re.Match[str]) -> str:
    """The match with a little of what stands around it."""
    begin = max(match.start() - 20, 0)
    passage = text[begin : begin + MOST_SHOWN]
    return _UNPRINTED.sub("\N{REPLACEMENT CHARACTER}", " ".join(passage.split(" "))).replace("\n", " ")
