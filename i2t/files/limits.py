"""Bounds on the files that i2t reads: real ones stay far below, hostile and damaged ones are refused."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReadLimits:
    """Largest sizes (bytes, pixels, entries) of the files, images and archives that i2t reads; larger are refused."""

    file_bytes: int = 2 * 2**30  # largest size (bytes) of a file that is read as a whole
    text_bytes: int = 2**20  # largest size (bytes) of a settings file; real ones have a few kilobytes
    toml_line_bytes: int = 4096  # largest length (bytes) of a line of TOML; a 6 x 6 matrix written in one line has 900
    line_bytes: int = 2**16  # largest length (bytes) of a line of a table; a row of 25 chips has about 1000
    # number of bytes at the beginning of a file from which its kind and its encoding are detected
    head_bytes: int = 2**16
    mesh_bytes: int = 2**28  # largest size (bytes) of a mesh file, together with the files that it names
    image_bytes: int = 2**28  # largest size (bytes) of an image file
    image_edge_pixels: int = 16384
    image_pixels: int = 2**25  # largest number of pixels of an image, more than any depth camera has
    archive_entries: int = 4096
    unpacked_spare_bytes: int = 16 * 2**20  # unpacked size (bytes) that is allowed for any archive, however small it is
    # largest ratio of unpacked to packed size beyond that allowance; numbers as text reach 10
    unpacked_growth: int = 40


READ_LIMITS = ReadLimits()  # largest sizes of files and of their contents; larger ones are refused
