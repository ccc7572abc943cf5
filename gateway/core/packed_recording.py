"""A recording as bytes: as it travels, and as it is kept beside the audit, so that it can be judged by again."""

import io

import numpy as np

from gateway.core.recording import ARRAYS, Recording

_HEADS = 16_384  #: bytes that names, shapes and the source take beside the numbers


def packed(recording: Recording) -> bytes:
    """NumPy's zip of all arrays. The same recording gives the same numbers back, not the same bytes each time."""
    stream = io.BytesIO()
    arrays = {name: getattr(recording, name) for name in ARRAYS}
    np.savez_compressed(stream, period_s=recording.period_s, source=np.array(recording.source), **arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> Recording:
    """Raises ValueError for anything else than `packed` makes."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in ARRAYS}
            return Recording(**arrays, period_s=float(stored["period_s"]), source=str(stored["source"]))
    except (OSError, KeyError, EOFError) as error:
        raise ValueError(f"it is no recording: {error}") from error


def most_samples(n: int, most_bytes: int) -> int:
    """Samples of n spans that `packed` surely makes no more than so many bytes of, however little they compress."""
    of_a_sample = 8 * (2 + 5 * n) + 1  # as `ARRAYS` are
    return max(1, (most_bytes - _HEADS) // of_a_sample)
