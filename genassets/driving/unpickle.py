"""Pickled numpy arrays and pandas tables of unknown origin, read without running what they name.

A pickle can name any importable function and call it. Only what arrays, or a DataFrame of numbers, text and an index
need is allowed here, under the names that pandas 0.25 to 3 and numpy 1 and 2 gave it; anything else is
refused before it is imported.
"""

from __future__ import annotations

import gzip
import io
import pickle
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from genassets.errors import LogError

if TYPE_CHECKING:
    import pandas

_INDEXES = "pandas.core.indexes.base"
_ARRAYS: frozenset[tuple[str, str]] = frozenset(
    [
        ("_codecs", "encode"),  # bytes in protocol 2: a text and a codec
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
        ("numpy._core.numeric", "_frombuffer"),
    ]
)
_TABLES = _ARRAYS | frozenset(
    [
        ("builtins", "slice"),
        ("builtins", "bytearray"),
        ("functools", "partial"),  # pandas 1.3 wraps new_block in it; what it wraps is looked up here too
        ("pandas", "DataFrame"),
        ("pandas", "Index"),
        ("pandas", "RangeIndex"),
        ("pandas", "StringDtype"),
        ("pandas.arrays", "ArrowStringArray"),
        ("pandas.arrays", "StringArray"),
        ("pandas.core.frame", "DataFrame"),
        ("pandas.core.internals.managers", "BlockManager"),
        ("pandas._libs.internals", "_unpickle_block"),
        (_INDEXES, "_new_Index"),
        (_INDEXES, "Index"),
        ("pandas.core.indexes.range", "RangeIndex"),
        ("pyarrow.lib", "_restore_array"),  # text columns as pandas 3 writes them
        ("pyarrow.lib", "py_buffer"),
        ("pyarrow.lib", "type_for_alias"),
    ]
)
_MOVED = {  # names of older releases, and where the same thing is now
    ("pandas.core.internals.blocks", "new_block"): ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.indexes.numeric", "Int64Index"): (_INDEXES, "Index"),
    ("pandas.core.indexes.numeric", "UInt64Index"): (_INDEXES, "Index"),
    ("pandas.core.indexes.numeric", "Float64Index"): (_INDEXES, "Index"),
}


class ForbiddenGlobal(pickle.UnpicklingError):
    """The pickle names something outside the allow-list."""


class ArrayUnpickler(pickle.Unpickler):
    """An unpickler that finds nothing but numpy arrays, beside Python's own containers, numbers and texts."""

    allowed = _ARRAYS

    def find_class(self, module: str, name: str) -> Any:
        """The allowed global; raises ForbiddenGlobal before anything else is imported."""
        if module == "__builtin__":
            module = "builtins"
        if module.startswith("numpy.core."):
            module = module.replace("numpy.core.", "numpy._core.", 1)
        module, name = _MOVED.get((module, name), (module, name))
        if (module, name) not in self.allowed:
            raise ForbiddenGlobal(f"{module}.{name}")
        return super().find_class(module, name)


class TableUnpickler(ArrayUnpickler):
    """An unpickler that finds nothing but the parts of a DataFrame."""

    allowed = _TABLES


def read_table(path: Path) -> pandas.DataFrame:
    """Read a DataFrame from `.pkl` or `.pkl.gz`.

    Raises LogError, naming the file, where the pickle is corrupt, names a forbidden global, or holds no
    DataFrame.
    """
    import pandas

    advice = "Download the file again, or delete it (missing tables are skipped)."
    try:
        content = path.read_bytes()
        if path.suffix == ".gz":
            content = gzip.decompress(content)
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: cannot be read or decompressed ({error}). {advice}") from error
    try:
        table = TableUnpickler(io.BytesIO(content)).load()
    except ForbiddenGlobal as error:
        raise LogError(
            f"{path}: the pickle names '{error}', which a table of numbers and text has no use for, so it "
            "was not loaded: it may run foreign code. Expected a pickled pandas DataFrame. Take the file "
            "from a source that you trust."
        ) from error
    except Exception as error:  # a corrupt pickle can raise anything at all
        raise LogError(
            f"{path}: the pickle is corrupt ({type(error).__name__}: {error}); expected a pickled pandas "
            f"DataFrame. {advice}"
        ) from error
    if not isinstance(table, pandas.DataFrame):
        raise LogError(
            f"{path}: holds a {type(table).__name__}; expected a pickled pandas DataFrame. {advice}"
        )
    return table
