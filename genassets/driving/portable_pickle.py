"""Pickles that old and new numpy and pandas open, with the same bytes every time."""

from __future__ import annotations

import gzip
import io
import pickle
import pickletools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas

PROTOCOL = 4  # the newest that Python 3.4 to 3.7 read, which the devkit ran on
COMPRESSION = 3  # sweeps are noise in their low bits: higher levels cost seconds and gain a few per cent


def make_table(
    columns: Mapping[str, NDArray[np.generic] | Sequence[str]], index_name: str | None = None
) -> pandas.DataFrame:
    """A DataFrame with object text columns, an object column index and an int64 row index.

    pandas 3 would otherwise infer its own string type, which older ones cannot unpickle. Equal texts become
    one
    object: pickle writes an object once, so the bytes would depend on which equal texts are the same object.
    """
    import pandas

    one_object: dict[str, str] = {}
    series = {}
    length = 0
    for name, values in columns.items():
        if isinstance(values, np.ndarray):
            series[name] = values
        else:
            texts = np.empty(len(values), dtype=object)
            texts[:] = [one_object.setdefault(text, text) for text in values]
            series[name] = texts
        length = len(values)
    index = pandas.Index(np.arange(length, dtype=np.int64), name=index_name)
    table = pandas.DataFrame(
        {name: pandas.Series(values, index=index, dtype=values.dtype) for name, values in series.items()},
        index=index,
    )
    table.columns = pandas.Index(np.array(list(columns), dtype=object), dtype=object)
    return table


def pickle_table(table: pandas.DataFrame) -> bytes:
    """The gzipped pickle of a table; see pickle_portably."""
    return gzip.compress(pickle_portably(table), COMPRESSION, mtime=0)


def pickle_portably(value: Any) -> bytes:
    """The pickle of a value, naming numpy's functions where numpy 1 and 2 both find them."""
    return _name_old_numpy(pickle.dumps(value, protocol=PROTOCOL))


def _name_old_numpy(stream: bytes) -> bytes:
    """The stream with numpy._core renamed to numpy.core, which numpy before 1.26 has under that name alone.

    Frames are left out: they give lengths that no longer hold, and an unpickler does without them.
    """
    operations = list(pickletools.genops(stream))
    ends = [position for _, _, position in operations[1:]] + [len(stream)]
    out = io.BytesIO()
    for (operation, argument, start), end in zip(operations, ends, strict=True):
        assert start is not None and end is not None
        if operation.name == "FRAME":
            continue
        if operation.name == "SHORT_BINUNICODE" and str(argument).startswith("numpy._core."):
            text = str(argument).replace("numpy._core.", "numpy.core.", 1).encode()
            out.write(pickle.SHORT_BINUNICODE + bytes([len(text)]) + text)
        else:
            out.write(stream[start:end])
    return out.getvalue()
