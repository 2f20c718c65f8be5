"""Errors that i2t raises for users to catch. Each message is one sentence that names what is wrong and the remedy."""

NAMED_WRONGLY = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)


class I2TError(Exception):
    """An error that the reader of its message can mend."""


class DataError(I2TError, ValueError):
    """A file or a data set that cannot be used; the message is one line that names it, what is wrong and the remedy.

    Args:
        message: What happened; line breaks become spaces.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # what a library reported may have several lines


class SerializationError(I2TError, ValueError):
    """A file of arrays that is damaged, or of another kind than asked for."""


class FullDiskError(DataError, SerializationError):
    """A file could not be kept, for no fault of its name: the disk is full, or failed."""


class MissingExtraError(I2TError, ModuleNotFoundError, ValueError):
    """A package that only some of i2t needs is not installed; the message names the extra that brings it."""


class CheckpointError(I2TError, ValueError):
    """A checkpoint that cannot be read back."""


class DeviceError(I2TError, RuntimeError):
    """A device failed, in one sentence."""


class NotConnectedError(DeviceError):
    """The device was used before `connect` or after `close`."""


class DeviceTimeoutError(DeviceError):
    """Nothing new came in time. The device may speak again by itself."""


class MotionStoppedError(DeviceError):
    """A motion ended because somebody called `stop`."""
