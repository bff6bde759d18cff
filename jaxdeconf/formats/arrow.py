"""Arrow files, in which Minari keeps an episode each: opened late, as arrays by path.

Shapes: T rows of one file.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf.formats.source import library, reading

# What h5py says of an array of bytes of any length, one a row, as image files are.
FILES = np.dtype(object, metadata={"vlen": np.uint8})


class Column:
    """A column of numbers or image files as NumPy has it, read when it is sliced."""

    def __init__(self, array: Any, shape: tuple[int, ...] | None = None):
        """Of Arrow's [T]; `shape` is that of a row of numbers, None: as it is stored."""
        stored, self._array = array.type, array
        self._lists = hasattr(stored, "list_size")
        flat = (stored.list_size,) if self._lists else ()
        self.shape = (len(array), *(shape if shape and flat else flat))
        number = stored.value_type if self._lists else stored
        self.dtype = FILES if stored == "binary" else np.dtype(number.to_pandas_dtype())

    def __len__(self) -> int:
        return len(self._array)

    def __getitem__(self, rows: Any) -> np.ndarray:
        flat = self._array.flatten() if self._lists else self._array
        return flat.to_numpy(zero_copy_only=False).reshape(self.shape)[rows]


def read(path: Path, extra: str) -> Any:
    """A file's rows, as one struct [T] of all columns.

    Raises:
      ValueError: if the file cannot be read; names its size, or what it is instead.
    """
    pa = library(path, "pyarrow", extra)
    with reading(path, "an Arrow file", pa.ArrowException), pa.memory_map(str(path)) as file:
        return pa.ipc.open_file(file).read_all().to_struct_array().combine_chunks()


def leaves(struct: Any, within: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays [T] in a struct, and in those in it, by path."""
    for place, field in enumerate(struct.type):
        array, path = struct.field(place), within + field.name
        if field.type.num_fields and not hasattr(field.type, "value_type"):
            yield from leaves(array, f"{path}/")
        else:
            yield path, array


def write(path: Path, struct: Any, new: Mapping[str, np.ndarray]) -> None:
    """Writes a struct with some of its arrays replaced, by path, by numbers [T, ...]."""
    import pyarrow as pa

    def replaced(array: Any, at: str) -> Any:
        if at in new:
            rows = new[at].reshape(len(array), -1)
            return pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), rows.shape[1])
        if not any(name.startswith(f"{at}/") for name in new):
            return array
        return rebuilt(array, f"{at}/")

    def rebuilt(struct: Any, within: str) -> Any:
        arrays = [struct.field(i) for i in range(struct.type.num_fields)]
        fields = [*struct.type]
        arrays = [replaced(a, within + field.name) for a, field in zip(arrays, fields, strict=True)]
        typed = [field.with_type(a.type) for a, field in zip(arrays, fields, strict=True)]
        return pa.StructArray.from_arrays(arrays, fields=typed)

    batch = pa.RecordBatch.from_struct_array(rebuilt(struct, ""))
    with pa.ipc.new_file(str(path), batch.schema) as file:
        file.write_batch(batch)
