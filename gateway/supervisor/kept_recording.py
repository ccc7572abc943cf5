"""A recording as bytes that are kept beside the audit: what a verdict was given on can be judged again."""

import io

import numpy as np

from gateway.core.recording import ARRAYS, Recording


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
