"""Detection of a file's kind and of its text encoding from its first bytes."""

import codecs
import re
from enum import StrEnum
from pathlib import Path

from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS

MARK_OF_TOUCHES = b"i2t-touches "  # first bytes of a file of touches (`i2t.dataset.files`)
GZIP_MARK = b"\x1f\x8b"  # first bytes of a gzip file
TABLE_SUFFIXES = (".csv", ".tsv", ".txt")  # file name endings of text tables
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")  # file name endings of meshes that can be read
METRE_SUFFIXES = (".glb", ".gltf")  # of these, formats whose unit is the metre (glTF 2.0, section 3.4)
# metres per unit in which the vertices of a mesh file may be given
METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 25.4e-3}
UTF_8, WINDOWS_1252 = "utf-8-sig", "cp1252"  # encodings of text files, tried in this order


class _Remedy(StrEnum):
    """What a user can do to get a table out of a file of another kind."""

    EXPORT = "export what you need of it as CSV in UTF-8"
    UNPACK = "unpack it first"
    SAVE_AS_CSV = "save it as CSV in UTF-8"
    SAVETXT = "write its columns with numpy.savetxt, with their names as the header"


# First bytes of files that are not tables, from the specification of each format, with their kind and remedy.
FILE_MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x93NUMPY", "a NumPy array (.npy)", _Remedy.SAVETXT),
    (b"PK\x03\x04", "a zip archive", _Remedy.UNPACK),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (.xls)", _Remedy.SAVE_AS_CSV),
    (b"PAR1", "an Apache Parquet file", "write it with pandas: read_parquet(...).to_csv(..., index=False)"),
    (b"ARROW1", "an Apache Arrow (Feather) file", "write it with pandas: read_feather(...).to_csv(..., index=False)"),
    (b"\x89MCAP0\r\n", "an MCAP recording", _Remedy.EXPORT),
    (b"#ROSBAG V", "a ROS bag", _Remedy.EXPORT),
    (b"SQLite format 3\0", "an SQLite database, as ROS 2 bags (.db3) are", _Remedy.EXPORT),
    (MARK_OF_TOUCHES, "a data set of i2t, and converted already", "use it as it is"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file", _Remedy.EXPORT),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"TDSm", "a LabVIEW recording (TDMS)", _Remedy.EXPORT),
    *((mark, "a compressed archive", _Remedy.UNPACK) for mark in (b"BZh", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd")),
    *((mark, "an image", "name a table") for mark in (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*")),
    (b"version https://git-lfs", "a Git LFS pointer and not the file itself", "fetch it with git lfs pull"),
    *((mark, "a web page (HTML)", "download the file itself") for mark in (b"<!doctype html", b"<html")),
    (b"<?xml", "an XML document", _Remedy.EXPORT),
    (b"{\\rtf", "a document in rich text (RTF)", "save its table as plain text, in CSV and UTF-8"),
    (GZIP_MARK, "a gzip archive", _Remedy.UNPACK),
    *((b"\x80" + bytes([protocol]), "a Python pickle", _Remedy.EXPORT) for protocol in range(2, 6)),
)
# Zip archives that are documents, recognised by the name of an entry: name, kind of document and remedy.
ZIP_ENTRY_NAMES: tuple[tuple[bytes, str, str], ...] = (
    (b"xl/", "an Excel workbook (.xlsx)", _Remedy.SAVE_AS_CSV),
    (b"[Content_Types].xml", "an Excel workbook or another Office document", _Remedy.SAVE_AS_CSV),
    (b"opendocument.spreadsheet", "an OpenDocument spreadsheet (.ods)", _Remedy.SAVE_AS_CSV),
    (b".npy", "a NumPy archive (.npz)", _Remedy.SAVETXT),
)


def kind_of(head: bytes) -> tuple[str, str]:
    """Recognise a file that is not a table by its first bytes.

    Args:
        head: The first `READ_LIMITS.head_bytes` bytes, or all bytes of a smaller file.

    Returns:
        The kind of file with its article, and a remedy: how to read its numbers. Both are empty for any other file.
    """
    if head.startswith(b"PK\x03\x04"):
        for name, kind, remedy in ZIP_ENTRY_NAMES:
            if name in head:
                return kind, remedy
    text = head.removeprefix(codecs.BOM_UTF8)
    markup = text.lstrip().lower()
    for mark, kind, remedy in FILE_MARKS:
        if (markup if mark.startswith((b"<", b"{")) else head).startswith(mark):
            return kind, remedy
    json_begins = re.match(rb'\s*(\{\s*["{}]|\[\s*[\[{"\]]|\[\s+[-0-9tfn])', text)  # indented or not
    return ("a JSON document", _Remedy.EXPORT) if json_begins else ("", "")


def encoding_of(path: str | Path, head: bytes, *, whole: bool) -> str:
    """Detect the encoding of a text.

    UTF-8, UTF-16 and UTF-32 are recognised by their byte order marks, and UTF-16 of ASCII characters also without a
    mark. Any other text is read as UTF-8 if its bytes allow it, and otherwise as Windows-1252, which spreadsheets
    write.

    Args:
        path: The file's path, for messages.
        head: The first `READ_LIMITS.head_bytes` bytes, or all bytes of a smaller file.
        whole: Whether `head` is the whole file.

    Returns:
        Python's name of the encoding, which is "utf-8-sig" for UTF-8.

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    kind, remedy = kind_of(head)
    if kind:
        raise DataError(f"{path}: is {kind}; {remedy}")
    for mark, encoding in (  # UTF-32 before UTF-16, whose marks begin the same
        (codecs.BOM_UTF8, UTF_8),
        (codecs.BOM_UTF32_LE, "utf-32"),
        (codecs.BOM_UTF32_BE, "utf-32"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if head.startswith(mark):
            return encoding
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # each ASCII character has a zero after or before it
        if len(head) > 3 and not any(head[first::2]) and all(head[1 - first : -1 : 2]):
            return encoding
    binary_bytes = frozenset(range(32)) - set(b"\t\n\v\f\r\x1a\x1b")  # control characters that no text contains
    if binary_bytes & set(head.rstrip(b"\0")):  # a power cut leaves zeros at the end of a log
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
        path: The file's path, for messages.
        data: The file's bytes.

    Returns:
        The text, without a byte order mark.

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    head = data[: READ_LIMITS.head_bytes]
    encoding = encoding_of(path, head, whole=len(head) == len(data))
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        name = encoding.removesuffix("-sig").upper()
        raise DataError(f"{path}: is not text in {name} (byte {error.start}); save it as CSV in UTF-8") from error
