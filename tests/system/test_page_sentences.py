"""What the gate says, in German, by the page's own modules: in node, without a browser."""

import json
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from gateway.operator.page.words import words_of
from tests.unit.test_page_sentences import WHOLES

STATIC = Path("gateway/operator/page/static")
VERDICT = json.loads(Path("docs/examples/verdict.json").read_bytes())
TEXTS = sorted(WHOLES)
TEXTS += [one["text"] for one in VERDICT["findings"] + VERDICT["reported"]]
#: Words that stand in no German sentence, but in what the gate says.
ENGLISH = re.compile(r"\b(at|to|and|of|the|is|are|allowed|from|with|up|never|them|than|which|no|end)\b")


@pytest.fixture(scope="module")
def modules(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("static")
    for file in STATIC.glob("*.js"):
        shutil.copy(file, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    return folder


def said(modules: Path, texts: list[str]) -> list[str | None]:
    return json.loads(
        subprocess.run(
            ["node", "tests/system/peers/sentences.mjs", str(modules)],
            input=json.dumps({"words": words_of("de"), "texts": texts}),
            capture_output=True, text=True, check=True, timeout=60.0,
        ).stdout
    )  # fmt: skip


def numbers(text: str) -> list[str]:
    """Each as English writes it, with its sign, in any order (tests/unit/test_page_sentences.py has the order)."""
    return sorted(re.findall(r"(?<!\w)[+-]?\d+(?:\.\d+)?", re.sub(r"(?<=\d),(?=\d)", ".", text.replace("−", "-"))))


def test_every_sentence_is_said_with_all_its_numbers_and_nothing_english_left(modules: Path):
    for english, german in zip(TEXTS, said(modules, TEXTS), strict=True):
        assert german is not None, english
        assert numbers(german) == numbers(english)
        assert not ENGLISH.search(german), german


def test_sentences_within_sentences_names_and_numbers_are_said_as_well(modules: Path):
    assert said(
        modules,
        [
            "tension falls to -8.17 N (span 2 alone, slow, late); allowed: down to 2 N",
            "the line runs at 0.0375, 0.05 m/s meanwhile",
            "span 3 would come to 61.2 N in 0.34 s if the fallback took over now, allowed: 54 N",
            "what is measured is in doubt: a load cell is stuck: check it, its amplifier and its cable",
            "span 3 nip: 61.0 N; allowed: 2 to 60 N; span 4 dryer: 1.0 N; allowed: 2 to 60 N",
        ],
    ) == [
        "der Zug fällt auf −8,17 N (Abschnitt 2 allein, langsam, mit mehr Totzeit); erlaubt: bis hinab zu 2 N",
        "die Anlage läuft dabei mit 0,0375, 0,05 m/s",
        "der Zug in Abschnitt 3 käme in 0,34 s auf 61,2 N, wenn der Rückfallregler jetzt übernähme, erlaubt: 54 N",
        "was gemessen wird, ist zweifelhaft: eine Messdose hängt fest: sie, ihren Verstärker und ihr Kabel prüfen",
        "Abschnitt 3 nip: 61,0 N; erlaubt: 2 bis 60 N; Abschnitt 4 dryer: 1,0 N; erlaubt: 2 bis 60 N",
    ]


def test_names_of_the_plant_and_words_of_people_stay_as_they_are(modules: Path):
    assert said(
        modules,
        [
            "span 3 paper: 61.0 N; allowed: 2 to 60 N",
            "drive of tension: FAULT",
            "the line has changed: paper, error: late",
            "rolled back: tension 3 swings by 4.20 N, allowed: 3.00 N",
            "author is late; allowed: gate.authors, which are operator, late",
        ],
    ) == [
        "Abschnitt 3 paper: 61,0 N; erlaubt: 2 bis 60 N",
        "Antrieb von tension: FAULT",
        "die Anlage ist eine andere: paper, error: late",
        "zurückgenommen: Zug 3 schwingt um 4,20 N, erlaubt: 3,00 N",
        "vorgeschlagen hat es late; erlaubt: gate.authors, das sind operator, late",
    ]


def test_what_the_catalogue_does_not_have_stays_as_it_was_said(modules: Path):
    texts = [
        "span 3 nip: BAD; it is a thing",
        "tension falls to 3 N",
        "tension falls to 3 N (neighbours); allowed: down to 2 N, or so",
        "",
        "and",
        "{",
    ]
    assert said(modules, texts) == [None] * len(texts)


def test_no_text_keeps_the_page_busy(modules: Path):
    """However it is made: each piece between is looked for once, and never again further on."""
    long = [
        piece * (2000 // len(piece)) for piece in ("a is ", "; ", ", ", "(at ", "span 1 ", " to ", "is 1; allowed: ")
    ]
    begin_s = time.monotonic()
    said(modules, ["x"])
    bare_s = time.monotonic() - begin_s
    begin_s = time.monotonic()
    said(modules, long * 20)
    assert time.monotonic() - begin_s < 20.0 * bare_s + 5.0
