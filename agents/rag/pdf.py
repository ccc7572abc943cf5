"""The text of a PDF file, read in a process of its own: a file that is made to do harm ends that one."""

import json
import subprocess
import sys
from pathlib import Path

READ_MAX_S = 60.0


def text_of_pdf(file: Path) -> tuple[str, str]:
    """Its title, empty where it has none, and its text. Raises ValueError with a reason."""
    worker = Path(__file__).with_name("pdf_worker.py")
    try:
        ended = subprocess.run(
            [sys.executable, "-I", str(worker), str(file)], capture_output=True, timeout=READ_MAX_S, check=False
        )
        answer = json.loads(ended.stdout)
    except subprocess.TimeoutExpired:
        raise ValueError(f"was not read within {READ_MAX_S:g} s: damaged, or made to hang") from None
    except ValueError:
        raise ValueError("ended its reader: damaged, or it needs more memory than a document may") from None
    if "refused" in answer:
        raise ValueError(answer["refused"])
    return answer["title"], answer["text"]
