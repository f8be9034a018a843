"""Reading and writing zips. What a file from a stranger unpacks to is bounded before it is unpacked. Importable without torch."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sb3_flock.errors import SettingsError

MAX_TEXT = 2**18
"""Largest number of bytes of a config, 20 times our longest: PyYAML reads about 100 kB a second."""

MAX_CURVES = 2**24
"""Largest number of bytes of a training's curves: 100 000 evaluations."""


def check_size(archive: zipfile.ZipFile, limit: int) -> None:
    """Check what all members together unpack to, by their headers; :func:`read_member` checks the headers.

    :raises ValueError: if it is more than ``limit`` bytes
    """
    size = sum(info.file_size for info in archive.infolist())
    if size > limit:
        raise ValueError(f"it unpacks to {size} bytes: at most {limit} are read")


def check_clock() -> None:
    """Check that the system's clock is at a time that a zip can hold, as it is not on a computer that starts without one.

    :raises SettingsError: if it is before 1980
    """
    now = time.localtime()
    if now.tm_year < 1980:
        raise SettingsError(f"the system's clock says {time.strftime('%Y-%m-%d', now)}: zip files need a date from 1980 on")


def read_member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """A member of at most so many bytes; the unpacked size is bounded, whatever the header says.

    :raises KeyError: if there is none
    :raises ValueError: if it is larger, or packed in an unusual way
    """
    info = archive.getinfo(name)
    if info.file_size > limit:
        raise ValueError(f"{name} has {info.file_size} bytes: at most {limit} are read")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is packed by another method than deflation")
    with archive.open(info) as file:
        content = file.read(max(1, info.file_size))  # a bare read() would unpack as much as there is
        if len(content) < info.file_size or file.read(1):
            raise ValueError(f"{name} has another size than its header says")
    return content


def read_curves(path: Path, limit: int = MAX_CURVES) -> dict[str, NDArray[np.float64]]:
    """The curves of a training, ``evaluations.npz``: arrays of numbers by name.

    :raises FileNotFoundError: if there is no such file
    :raises ValueError: for a file that is damaged, too large, or holds anything but numbers
    """
    curves = {}
    try:
        with zipfile.ZipFile(path) as archive:
            check_size(archive, limit)
            for name in archive.namelist():
                array = np.lib.format.read_array(io.BytesIO(read_member(archive, name, limit)), allow_pickle=False)
                if array.dtype.kind not in "iuf":
                    raise ValueError(f"{name} holds {array.dtype} where numbers are needed")
                curves[name.removesuffix(".npy")] = array.astype(np.float64)
    except FileNotFoundError:
        raise
    except (OSError, KeyError, EOFError, MemoryError, OverflowError, zipfile.BadZipFile) as error:
        raise ValueError(" ".join(str(error).split())) from None
    return curves


def read_text(path: Path, limit: int = MAX_TEXT) -> str:
    """A file's text, in UTF-8.

    :raises OSError: if it cannot be read
    :raises ValueError: if it is not UTF-8, or longer than ``limit`` bytes
    """
    with open(path, "rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"it has more than {limit} bytes")
    return content.decode("utf-8")
