"""Reads one PDF file and prints its text as JSON; started by agents/rag/pdf.py, bounded in memory and time."""

import json
import logging
import resource
import sys
import warnings

MOST_MEMORY_BYTES = 1 << 30
MOST_PROCESSOR_S = 60
MOST_PAGES = 3000


def main() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_PROCESSOR_S, MOST_PROCESSOR_S))
    warnings.simplefilter("ignore")
    logging.disable()  # what pypdf finds odd in a file that it reads all the same
    print(json.dumps(answer(sys.argv[1])))


def answer(file: str) -> dict[str, str]:
    from pypdf import PdfReader
    from pypdf.errors import PyPdfError

    try:
        reader = PdfReader(file)
        if reader.is_encrypted:
            return {"refused": "is encrypted: add a copy without a password"}
        if len(reader.pages) > MOST_PAGES:
            return {"refused": f"has {len(reader.pages)} pages; allowed: {MOST_PAGES}. Add the part that is needed"}
        text = "\n\n".join(page.extract_text() for page in reader.pages)
        title = str((reader.metadata and reader.metadata.title) or "")
    except (PyPdfError, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        return {"refused": f"is no PDF that can be read: {type(error).__name__}: {str(error)[:200]}"}
    if not text.strip():
        return {"refused": "has no text, only pictures of it: have its text recognised first"}
    return {name: said.encode(errors="replace").decode() for name, said in (("title", title), ("text", text))}


if __name__ == "__main__":
    main()
