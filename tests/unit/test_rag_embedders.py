"""Embedders: the encoder against a plain one, word pieces, weights that are not known, an Ollama that errs."""

import asyncio
import importlib.util
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.rag.bert import Bert, tensors_in
from agents.rag.embedder import EmbedderFailed, unit_rows
from agents.rag.minilm import PACKAGE, MiniLm
from agents.rag.ollama_embedder import OllamaEmbedder
from agents.rag.wordpiece import WordPieces

WIDTH, HEADS, LAYERS, INNER = 8, 2, 2, 12
VOCABULARY = "[PAD] [UNK] [CLS] [SEP] tension load ##ing ##s cell - 2 . a ##m 中 µm".split()


def random_weights() -> dict[str, NDArray[np.float32]]:
    generator = np.random.default_rng(5)
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.word_embeddings.weight": (20, WIDTH),
        "embeddings.position_embeddings.weight": (10, WIDTH),
        "embeddings.token_type_embeddings.weight": (2, WIDTH),
        "embeddings.LayerNorm.weight": (WIDTH,),
        "embeddings.LayerNorm.bias": (WIDTH,),
    }
    for layer in range(LAYERS):
        name = f"encoder.layer.{layer}"
        linears = [(f"attention.self.{part}", WIDTH, WIDTH) for part in ("query", "key", "value")]
        linears += [("attention.output.dense", WIDTH, WIDTH), ("intermediate.dense", INNER, WIDTH)]
        for part, rows, columns in [*linears, ("output.dense", WIDTH, INNER)]:
            shapes |= {f"{name}.{part}.weight": (rows, columns), f"{name}.{part}.bias": (rows,)}
        for part in ("attention.output.LayerNorm", "output.LayerNorm"):
            shapes |= {f"{name}.{part}.weight": (WIDTH,), f"{name}.{part}.bias": (WIDTH,)}
    return {name: generator.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}


def plain_states(weights: dict[str, NDArray[np.float32]], numbers: list[int]) -> NDArray[np.float64]:
    """The same encoder, a vector and a head at a time, in double precision."""
    from math import erf

    w = {name: array.astype(float) for name, array in weights.items()}

    def normalised(x: NDArray[Any], name: str) -> NDArray[Any]:
        return (x - x.mean()) / np.sqrt(x.var() + 1e-12) * w[f"{name}.weight"] + w[f"{name}.bias"]

    def linear(x: NDArray[Any], name: str) -> NDArray[Any]:
        return w[f"{name}.weight"] @ x + w[f"{name}.bias"]

    rows = [
        normalised(
            w["embeddings.word_embeddings.weight"][number]
            + w["embeddings.position_embeddings.weight"][place]
            + w["embeddings.token_type_embeddings.weight"][0],
            "embeddings.LayerNorm",
        )
        for place, number in enumerate(numbers)
    ]
    size = WIDTH // HEADS
    for layer in range(LAYERS):
        name = f"encoder.layer.{layer}"
        attended = []
        for x in rows:
            parts = []
            for head in range(HEADS):
                cut = slice(head * size, (head + 1) * size)
                query = linear(x, f"{name}.attention.self.query")[cut]
                scores = np.array([query @ linear(y, f"{name}.attention.self.key")[cut] for y in rows]) / np.sqrt(size)
                shares = np.exp(scores) / np.exp(scores).sum()
                values = [linear(y, f"{name}.attention.self.value")[cut] for y in rows]
                parts.append(sum(share * value for share, value in zip(shares, values, strict=True)))
            attended.append(np.concatenate(parts))
        for k, (x, mixed) in enumerate(zip(list(rows), attended, strict=True)):
            y = normalised(x + linear(mixed, f"{name}.attention.output.dense"), f"{name}.attention.output.LayerNorm")
            inner = linear(y, f"{name}.intermediate.dense")
            inner = np.array([v * 0.5 * (1 + erf(v / np.sqrt(2))) for v in inner])
            rows[k] = normalised(y + linear(inner, f"{name}.output.dense"), f"{name}.output.LayerNorm")
    return np.array(rows)


def test_the_encoder_computes_what_a_plain_one_computes() -> None:
    weights = random_weights()
    numbers = [2, 4, 4, 17, 3]
    assert Bert(weights, HEADS).states(numbers) == pytest.approx(plain_states(weights, numbers), abs=2e-5)


def test_tensors_are_read_by_name_and_shape() -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    head = {"a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}, "__metadata__": {}}
    packed = json.dumps(head).encode()
    content = len(packed).to_bytes(8, "little") + packed + values.tobytes()
    assert np.array_equal(tensors_in(content)["a"], values)
    for damaged in (content[:-4], b"", content.replace(b"F32", b"F31"), b"\xff" * 64):
        with pytest.raises(ValueError):
            tensors_in(damaged)


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        ("Tension", ["tension"]),
        ("LOADING loads", ["load", "##ing", "load", "##s"]),
        ("load-cell 2.", ["load", "-", "cell", "2", "."]),
        ("ténsion", ["tension"]),
        ("zebra", ["[UNK]"]),
        ("loadx", ["[UNK]"]),
        ("a中a", ["a", "中", "a"]),
        ("te\u0000nsion\tam\u200b", ["tension", "a", "##m"]),
        ("a" * 101, ["[UNK]"]),
        ("", []),
    ],
)
def test_words_are_cut_into_the_longest_pieces(text: str, pieces: list[str]) -> None:
    numbers = WordPieces(VOCABULARY).numbers(text, 32)
    assert [VOCABULARY[number] for number in numbers] == ["[CLS]", *pieces, "[SEP]"]


def test_a_long_text_is_cut_and_still_ends() -> None:
    numbers = WordPieces(VOCABULARY).numbers("tension " * 100, 16)
    assert len(numbers) == 16 and VOCABULARY[numbers[-1]] == "[SEP]"


def test_weights_that_are_not_the_known_ones_are_not_used(tmp_path: Path) -> None:
    with pytest.raises(EmbedderFailed, match="cannot be read.*make minilm"):
        MiniLm(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"other weights")
    with pytest.raises(EmbedderFailed, match="SHA-256 .* it is not used"):
        MiniLm(tmp_path)


@pytest.mark.skipif(importlib.util.find_spec(PACKAGE) is None, reason="make minilm installs its weights")
def test_minilm_gives_the_cosines_that_its_authors_publish() -> None:
    """From its model card: happy person against happy dog, very happy person, sunny day."""
    sentences = [
        "That is a happy person", "That is a happy dog", "That is a very happy person", "Today is a sunny day",
    ]  # fmt: skip
    vectors = asyncio.run(MiniLm().embed(sentences))
    assert vectors[1:] @ vectors[0] == pytest.approx([0.695, 0.943, 0.257], abs=1e-3)


def test_vectors_without_a_direction_or_of_another_shape_are_refused() -> None:
    assert unit_rows(np.array([[3.0, 4.0]]), 1, 2).tolist() == [[np.float32(0.6), np.float32(0.8)]]
    for bad in ([[0.0, 0.0]], [[np.nan, 1.0]], [[1.0, 2.0, 3.0]], [[1.0, 2.0], [1.0, 2.0]]):
        with pytest.raises(EmbedderFailed):
            unit_rows(np.array(bad), 1, 2)


Answer = Callable[[list[str]], object]


@contextmanager
def ollama(answer: Answer, models: object = None) -> Iterator[str]:
    """A server that speaks as much of Ollama's HTTP as an embedder needs; its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.say({"models": [{"model": "words:latest", "digest": "d" * 64}]} if models is None else models)

        def do_POST(self) -> None:
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            self.say(answer(asked["input"]))

        def say(self, what: object) -> None:
            status, body = what if isinstance(what, tuple) else (200, what)
            content = body if isinstance(body, bytes) else json.dumps(body).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def vectors_for(texts: list[str]) -> object:
    return {"model": "words", "embeddings": [[float(len(text)), 1.0, 0.0] for text in texts]}


async def embedded(url: str, texts: list[str], model: str = "words") -> tuple[object, NDArray[np.float32]]:
    async with await OllamaEmbedder.begin(model, url, answer_max_s=10.0) as embedder:
        return embedder.identity, await embedder.embed(texts)


@pytest.mark.wires
def test_ollama_gives_vectors_and_the_digest_of_its_weights() -> None:
    with ollama(vectors_for) as url:
        identity, vectors = asyncio.run(embedded(url, ["a", "abc"]))
    assert identity.name == "ollama:words" and identity.dimension == 3 and identity.sha256 == "d" * 64  # pyright: ignore
    assert vectors[1] == pytest.approx(np.array([3.0, 1.0, 0.0]) / np.sqrt(10))


def only_at_first(then: object) -> Answer:
    asked: list[object] = []

    def answer(texts: list[str]) -> object:
        asked.append(texts)
        return vectors_for(texts) if len(asked) == 1 else then

    return answer


@pytest.mark.parametrize(
    "then",
    [
        (500, {"error": "out of memory"}),
        b"<html>",
        {"model": "words", "embeddings": []},
        {"model": "words", "embeddings": [[1.0, 2.0, 3.0]]},
        {"model": "words", "embeddings": [[1.0], [2.0, 3.0]]},
        {"model": "words", "embeddings": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]},
        {"model": "words", "embeddings": [[1.0, 1.0], [1.0, 1.0]]},
        {"model": "words"},
    ],
)
def test_an_answer_that_is_no_vectors_is_a_failure_that_is_told(then: object) -> None:
    with ollama(only_at_first(then)) as url, pytest.raises(EmbedderFailed):
        asyncio.run(embedded(url, ["a", "b"]))


@pytest.mark.wires
def test_a_server_that_is_away_or_lacks_the_model_says_what_to_do() -> None:
    with ollama(vectors_for) as url, pytest.raises(EmbedderFailed, match="ollama pull other fetches it; it has words"):
        asyncio.run(embedded(url, ["a"], "other"))
    with ollama(vectors_for, models=(200, b"no json")) as url, pytest.raises(EmbedderFailed, match="does not answer"):
        asyncio.run(embedded(url, ["a"]))
    with pytest.raises(EmbedderFailed, match="Start it, or search by words"):
        asyncio.run(embedded(url, ["a"]))  # it has gone
