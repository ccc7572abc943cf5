"""Search by words: passages by BM25 (SQLite's FTS5), then documents by their title, keywords and best passages.

Documents are scored by BM25 over weighted fields (Robertson, Zaragoza and Taylor, Simple BM25 extension to multiple
weighted fields, CIKM 2004): counts of a word in the fields are weighted and added before they saturate, and so are
those of the words that stand for it. A passage alone does not say what it is about; its title does.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace

from agents.rag.database import Database
from agents.rag.documents import TIERS, Tier
from agents.rag.question_words import Concept, Phrase
from agents.rag.stages import FoundDocument, FoundPassage

MOST_PASSAGES = 100  #: taken from the first search
MOST_SHOWN = 10  #: documents of which the passage that says most is looked for
MOST_OWN = 30  #: further ones, by the question's own words alone
PASSAGES_A_DOCUMENT = 4  #: of a long document, the best ones count
MOST_MENTIONS = 3000  #: passages with a word of the question that are scored in the first search, over all words
SATURATION = 5.0  #: k1: how much more a second mention says than a first
LENGTH = 0.3  #: b: how far a long field counts less
TITLE, KEYWORDS, ASKED, BODY = 5.0, 5.0, 3.0, 1.0


Field = tuple[str, float]  #: stems, a space before and after each; what one mention there counts
#: Of a concept what it is worth, then its words and its longer phrases, each with its share of that.
Worth = list[tuple[float, list[tuple[str, float]], list[tuple[Phrase, float]]]]


class Words:
    """The words of an index. `mean_stems`: of titles, of keywords, of questions, of passages."""

    def __init__(self, connection: Database, chunks: int, mean_stems: Sequence[float]) -> None:
        self._connection = connection
        self._chunks = chunks
        self._mean_title, self._mean_keywords, self._mean_asked, self._mean_text = (
            max(mean, 1.0) for mean in mean_stems
        )

    def search(
        self, concepts: Sequence[Concept], tiers: Sequence[Tier]
    ) -> tuple[list[FoundPassage], list[FoundDocument]]:
        """Passages, up to MOST_PASSAGES and then MOST_OWN, and the documents that they are of; the best first."""
        known = self._frequencies(concepts)
        telling = self._telling(concepts, known)
        passages = self._passages(telling, tiers) if telling else []
        # FTS5 weighs what stands for a word as the word itself: whatever has the question's own words is looked at too.
        said = {concept.said for concept in concepts}
        if own := [phrase for phrase in telling if phrase in said]:
            seen = {one.chunk for one in passages}
            passages += [one for one in self._passages(own, tiers)[:MOST_OWN] if one.chunk not in seen]
        return passages, self._documents(self._worth(concepts, known), passages)

    def _passages(self, wanted: Sequence[Phrase], tiers: Sequence[Tier]) -> list[FoundPassage]:
        match = " OR ".join(f'"{" ".join(phrase)}"' for phrase in wanted)
        # Every tier asked for: the best are taken before anybody looks up whose they are, which is much quicker.
        limit = f"ORDER BY score LIMIT {MOST_PASSAGES}" if set(tiers) == set(TIERS) else ""
        rows = self._connection.execute(
            "SELECT word.rowid, chunk.document, -score FROM"
            f" (SELECT rowid, bm25(word, {TITLE}, {KEYWORDS}, {ASKED}, {BODY}) AS score FROM word"
            f" WHERE word MATCH ? {limit}) AS word"
            " JOIN chunk ON chunk.id = word.rowid JOIN document ON document.id = chunk.document"
            f" WHERE document.tier IN ({','.join('?' * len(tiers))}) ORDER BY score LIMIT {MOST_PASSAGES}",
            (match, *tiers),
        )
        return [FoundPassage(*row) for row in rows]

    def _telling(self, concepts: Sequence[Concept], known: dict[str, int]) -> list[Phrase]:
        """The phrases that are searched for: the rarest, up to MOST_MENTIONS; common ones would find everything."""
        rarity: dict[Phrase, float] = {}
        for concept in concepts:
            for phrase, weight in concept.phrases:
                if frequency := _frequency(phrase, known):
                    worth = concept.weight * weight * self._rarity(frequency)
                    rarity[phrase] = max(rarity.get(phrase, 0.0), worth)
        chosen: list[Phrase] = []
        mentions = 0
        for phrase in sorted(rarity, key=lambda one: -rarity[one]):
            mentions += _frequency(phrase, known)
            if chosen and mentions > MOST_MENTIONS:
                break
            chosen.append(phrase)
        return chosen

    def _documents(self, worth: Worth, passages: Sequence[FoundPassage]) -> list[FoundDocument]:
        chunks: dict[int, list[int]] = defaultdict(list)
        for passage in passages:
            if len(chunks[passage.document]) < PASSAGES_A_DOCUMENT:
                chunks[passage.document].append(passage.chunk)
        words = frozenset(word for _, singles, _ in worth for word, _ in singles)
        words |= frozenset(word for _, _, longer in worth for phrase, _ in longer for word in phrase)
        texts = self._stems("chunk", "stems", [chunk for some in chunks.values() for chunk in some])
        heads = self._stems("document", "title_stems, keyword_stems, asked_stems, about_stems", chunks)
        found: list[FoundDocument] = []
        for document, own in chunks.items():
            title, keywords, asked, about = heads[document]
            body = about + "".join(texts[chunk][0] for chunk in own)
            fields = [
                _field(title, TITLE, self._mean_title),
                _field(keywords, KEYWORDS, self._mean_keywords),
                _field(asked, ASKED, self._mean_asked),
                _field(body, BODY, self._mean_text * len(own)),
            ]
            found.append(FoundDocument(document, _score(worth, words, fields), own[0]))
        found.sort(key=lambda one: -one.score)

        def own_words(chunk: int) -> float:
            return _score(worth, words, [_field(texts[chunk][0], BODY, self._mean_text)])

        # A short passage that has the words in nothing but its document's title tells nothing.
        best = [replace(one, chunk=max(chunks[one.document], key=own_words)) for one in found[:MOST_SHOWN]]
        return best + found[MOST_SHOWN:]

    def _worth(self, concepts: Sequence[Concept], known: dict[str, int]) -> Worth:
        worth: Worth = []
        for concept in concepts:
            phrases = [(phrase, weight) for phrase, weight in concept.phrases if _frequency(phrase, known)]
            if phrases:  # where nobody uses the word itself, what stands for it most often says how rare it is
                own = _frequency(concept.said, known) or max(_frequency(phrase, known) for phrase, _ in phrases)
                rarity = self._rarity(own)
                shares = [
                    (phrase, weight * min(self._rarity(_frequency(phrase, known)) / rarity, 1.0))
                    for phrase, weight in phrases
                ]
                singles = [(phrase[0], share) for phrase, share in shares if len(phrase) == 1]
                longer = [(phrase, share) for phrase, share in shares if len(phrase) > 1]
                worth.append((concept.weight * rarity, singles, longer))
        return worth

    def _rarity(self, frequency: float) -> float:
        return math.log(1.0 + (self._chunks - frequency + 0.5) / (frequency + 0.5))

    def _frequencies(self, concepts: Sequence[Concept]) -> dict[str, int]:
        """In how many passages each word is."""
        words = {word for concept in concepts for phrase, _ in concept.phrases for word in phrase}
        rows = self._connection.execute(
            f"SELECT term, doc FROM word_count WHERE term IN ({','.join('?' * len(words))})", tuple(words)
        )
        return dict(rows.fetchall())

    def _stems(self, table: str, columns: str, ids: Iterable[int]) -> dict[int, tuple[str, ...]]:
        numbers = ",".join(map(str, ids))
        rows = self._connection.execute(f"SELECT id, {columns} FROM {table} WHERE id IN ({numbers})")
        return {number: tuple(texts) for number, *texts in rows}


def _frequency(phrase: Phrase, known: dict[str, int]) -> int:
    """In how many passages it can be at most."""
    return min(known.get(word, 0) for word in phrase)


def _field(text: str, weight: float, mean_stems: float) -> Field:
    return text, weight / (1.0 - LENGTH + LENGTH * text.count(" ") / mean_stems)


def _score(worth: Worth, words: frozenset[str], fields: Sequence[Field]) -> float:
    counts: defaultdict[str, float] = defaultdict(float)
    for text, weight in fields:
        for word in text.split():
            if word in words:
                counts[word] += weight
    total = 0.0
    for most, singles, longer in worth:
        said = 0.0
        for word, share in singles:
            if word in counts:
                said += share * counts[word]
        for phrase, share in longer:
            if all(word in counts for word in phrase):
                said += share * _mentions(phrase, fields)
        total += most * said * (SATURATION + 1.0) / (said + SATURATION)
    return total


def _mentions(phrase: Phrase, fields: Sequence[Field]) -> float:
    text_of_phrase = f" {' '.join(phrase)} "
    return sum(weight * text.count(text_of_phrase) for text, weight in fields)
