"""Parquet files: written in one form, opened within limits (docs/threat-model.md)."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

# What reading raises for damaged and for crafted files.
UNREADABLE = (pa.ArrowException, KeyError, TypeError, ValueError, OSError, RecursionError)

_MAX_FILE_BYTES = 8 << 30
# A kilobyte of Parquet can stand for terabytes; recorded numbers compress far less than 100 times.
_MAX_DECODED_BYTES = 2 << 30
_MAX_RATIO = 100


def writer(
    path: Path, schema: pa.Schema, repeating: Sequence[str] | None = None
) -> pq.ParquetWriter:
    """A writer of ``path`` with zstd compression and page checksums.

    Columns other than ``repeating`` are written without a dictionary: building one for recorded
    numbers, which rarely repeat, takes longer than everything else. None: Arrow tries every column.
    """
    return pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        write_page_checksum=True,
        use_dictionary=True if repeating is None else list(repeating),
    )


def write_table(table: pa.Table, path: Path) -> None:
    """Write ``table`` as one row group."""
    with writer(path, table.schema) as file:
        file.write_table(table, row_group_size=max(1, table.num_rows))


def open_table(path: Path, texts: Sequence[str] = ()) -> pq.ParquetFile:
    """Open ``path`` and check its footer; no column is read yet.

    The columns ``texts`` are read as dictionaries: a long text repeated in every row then takes
    its memory once.

    Raises:
        ValueError: not a regular file, or too large, compressed or decoded.
        OSError, ArrowException: not readable as Parquet.
    """
    information = path.stat()
    if not stat.S_ISREG(information.st_mode):
        # Opening a named pipe would wait for a writer forever.
        raise ValueError("not a regular file")
    size = information.st_size
    if size > _MAX_FILE_BYTES:
        raise ValueError(f"larger than {_MAX_FILE_BYTES >> 30} GiB")
    file = pq.ParquetFile(path, read_dictionary=list(texts), page_checksum_verification=True)
    declared = _declared_bytes(file)
    if declared > max(_MAX_DECODED_BYTES, _MAX_RATIO * size):
        file.close()
        raise ValueError(f"{size:,} bytes declare {declared:,} bytes of data")
    return file


def batches(
    file: pq.ParquetFile, size: int, columns: Sequence[str] | None = None
) -> Iterator[pa.RecordBatch]:
    """The rows of ``file``, at most ``size`` at a time.

    Arrow keeps all row groups of one request in memory. So row groups are requested together only
    until they hold ``size`` rows.
    """
    chosen: list[int] = []
    rows = 0
    for group in range(file.num_row_groups):
        chosen.append(group)
        rows += file.metadata.row_group(group).num_rows
        if rows >= size or group == file.num_row_groups - 1:
            yield from file.iter_batches(size, row_groups=chosen, columns=columns)
            chosen, rows = [], 0


def _declared_bytes(file: pq.ParquetFile) -> int:
    """Size of the decoded columns by the footer: fixed-width values and uncompressed pages.

    Column chunks are not inspected: ``RowGroupMetaData.column`` aborts the process on some
    crafted footers (pyarrow 26), which reading reports as errors.
    """
    groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    width = sum(_width(kind) for kind in file.schema_arrow.types)
    return sum(group.num_rows * width + group.total_byte_size for group in groups)


def _width(kind: pa.DataType) -> int:
    """Bytes of a decoded value; 0 for types of variable width."""
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _width(kind.value_type)
    return -(-kind.bit_width // 8) if pa.types.is_primitive(kind) else 0
