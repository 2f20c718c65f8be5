"""What a file is, and how its text is encoded, by its first bytes."""

import codecs
import re
from pathlib import Path

from i2t.errors import DataError

MAX_MESH_BYTES = 2**28  # of a file of a mesh, and of the files that it names
MARK_OF_TOUCHES = b"i2t-touches "  # with which a file of touches begins (`i2t.dataset.files`)
TABLE_SUFFIXES, MESH_SUFFIXES = (".csv", ".tsv", ".txt"), (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")
GZIP_MARK = b"\x1f\x8b"
HEAD_BYTES = 2**16  # first bytes of a file, from which its kind and its encoding are detected
EXPORT, UNPACK = "export what you need of it as CSV in UTF-8", "unpack it first"
# First bytes of files that are not tables, by the specification of each format, and how their numbers become a table.
FILE_MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x93NUMPY", "a NumPy array (.npy)", "write its columns with numpy.savetxt, with their names as the header"),
    (b"PK\x03\x04", "a zip archive", UNPACK),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (.xls)", "save it as CSV in UTF-8"),
    (b"PAR1", "an Apache Parquet file", "write it with pandas: read_parquet(...).to_csv(..., index=False)"),
    (b"ARROW1", "an Apache Arrow (Feather) file", "write it with pandas: read_feather(...).to_csv(..., index=False)"),
    (b"\x89MCAP0\r\n", "an MCAP recording", EXPORT),
    (b"#ROSBAG V", "a ROS bag", EXPORT),
    (b"SQLite format 3\0", "an SQLite database, as ROS 2 bags (.db3) are", EXPORT),
    (MARK_OF_TOUCHES, "a data set of i2t, and converted already", "use it as it is"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file", EXPORT),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"TDSm", "a LabVIEW recording (TDMS)", EXPORT),
    *((mark, "a compressed archive", UNPACK) for mark in (b"BZh", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd")),
    *((mark, "an image", "name a table") for mark in (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*")),
    (b"version https://git-lfs", "a Git LFS pointer and not the file itself", "fetch it with git lfs pull"),
    (b"<!doctype html", "a web page (HTML)", "download the file itself"),
    (b"<html", "a web page (HTML)", "download the file itself"),
    (b"<?xml", "an XML document", EXPORT),
    (b"{\\rtf", "a document in rich text (RTF)", "save its table as plain text, in CSV and UTF-8"),
    (GZIP_MARK, "a gzip archive", UNPACK),
    *((b"\x80" + bytes([protocol]), "a Python pickle", EXPORT) for protocol in range(2, 6)),
)
JSON_BEGINS = re.compile(rb'\s*(\{\s*["{}]|\[\s*[\[{"\]]|\[\s+[-0-9tfn])')  # indented or not
ZIP_NAMES: tuple[tuple[bytes, str, str], ...] = (  # names of entries in zip archives that are documents
    (b"xl/", "an Excel workbook (.xlsx)", "save it as CSV in UTF-8"),
    (b"[Content_Types].xml", "an Excel workbook or another Office document", "save it as CSV in UTF-8"),
    (b"opendocument.spreadsheet", "an OpenDocument spreadsheet (.ods)", "save it as CSV in UTF-8"),
    (b".npy", "a NumPy archive (.npz)", "write its columns with numpy.savetxt, with their names as the header"),
)
UNICODE_MARKS = (  # those of UTF-32 first, which begin with those of UTF-16
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
UTF_8, WINDOWS_1252 = "utf-8-sig", "cp1252"
NO_TEXT_BYTES = frozenset(range(32)) - set(b"\t\n\v\f\r\x1a\x1b")  # control characters that no text has


def kind_of(head: bytes) -> tuple[str, str]:
    """Recognise a file that is not a table by its first bytes.

    Args:
        head: The first `HEAD_BYTES` bytes, or all of a smaller file.

    Returns:
        The kind of file, with its article, and how its numbers can be read; two empty texts for any other file.
    """
    if head.startswith(b"PK\x03\x04"):
        for name, kind, remedy in ZIP_NAMES:
            if name in head:
                return kind, remedy
    text = head.removeprefix(codecs.BOM_UTF8)
    markup = text.lstrip().lower()
    for mark, kind, remedy in FILE_MARKS:
        if (markup if mark.startswith((b"<", b"{")) else head).startswith(mark):
            return kind, remedy
    return ("a JSON document", EXPORT) if JSON_BEGINS.match(text) else ("", "")


def encoding_of(path: str | Path, head: bytes, *, whole: bool) -> str:
    """Detect the encoding of a text.

    UTF-8, UTF-16 and UTF-32 are recognised by their marks, and UTF-16 of ASCII characters without one. Other texts are
    in UTF-8 if their bytes allow it, else in Windows-1252, which spreadsheets write.

    Args:
        path: The file, for messages.
        head: The first `HEAD_BYTES` bytes, or all of a smaller file.
        whole: Whether `head` is all of the file.

    Returns:
        Python's name of the encoding; that of UTF-8 is "utf-8-sig".

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    kind, remedy = kind_of(head)
    if kind:
        raise DataError(f"{path}: is {kind}; {remedy}")
    for mark, encoding in UNICODE_MARKS:
        if head.startswith(mark):
            return encoding
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # zeros stand after, or before, each character
        if len(head) > 3 and not any(head[first::2]) and all(head[1 - first : -1 : 2]):
            return encoding
    if NO_TEXT_BYTES & set(head.rstrip(b"\0")):  # a power cut leaves zeros at the end of a log
        raise DataError(f"{path}: is binary data, not text; save it as CSV in UTF-8")
    for encoding in (UTF_8, WINDOWS_1252):
        try:
            codecs.getincrementaldecoder(encoding)().decode(head, final=whole)
        except UnicodeDecodeError:
            continue
        return encoding
    raise DataError(f"{path}: is not text in UTF-8 or Windows-1252; save it as CSV in UTF-8")


def decoded(path: str | Path, data: bytes) -> str:
    """Decode the bytes of a text file by the encoding that `encoding_of` detects.

    Args:
        path: Of the file, for messages.
        data: Its bytes.

    Returns:
        The text, without a byte order mark.

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    encoding = encoding_of(path, data[:HEAD_BYTES], whole=len(data) <= HEAD_BYTES)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        name = encoding.removesuffix("-sig").upper()
        raise DataError(f"{path}: is not text in {name} (byte {error.start}); save it as CSV in UTF-8") from error
