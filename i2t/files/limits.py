"""Bounds on the files that i2t reads: real ones stay far below, hostile and damaged ones are refused."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReadLimits:
    """Largest sizes that are accepted."""

    file_bytes: int = 2 * 2**30  # any file that is read as a whole
    text_bytes: int = 2**20  # a settings file; real ones have a few kilobytes
    toml_line_bytes: int = 4096  # a line of TOML; a 6 x 6 matrix written in one line has 900
    line_bytes: int = 2**16  # a line of a table; a row of 25 chips has about 1000
    head_bytes: int = 2**16  # the beginning of a file, from which its kind and its encoding are detected
    mesh_bytes: int = 2**28  # a mesh file, together with the files that it names
    image_bytes: int = 2**28  # an image file
    image_edge_pixels: int = 16384
    image_pixels: int = 2**25  # more than any depth camera has
    archive_entries: int = 4096
    unpacked_spare_bytes: int = 16 * 2**20  # any archive may unpack to this, however small it is
    unpacked_growth: int = 40  # beyond that, the unpacked size relative to the packed one; numbers as text reach 10


READ_LIMITS = ReadLimits()
