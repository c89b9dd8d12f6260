"""
The one file format, of models, checkpoints and replay buffers::

    <section>.json          values; arrays stand in it by name
    <section>/<place>.npy   one array each
    manifest.json           format and version, kind of file, versions of the libraries, size and SHA-256 of every member

It is a zip whose members are stored as they are, so ``unzip`` and ``numpy.load`` open it, and it cannot unfold to more
than its size. The archive comment at its very end is the SHA-256 of all bytes before: no damage goes unseen. Nothing in it
is ever run: see :mod:`sb3_kfcv.saving.values`.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import pathlib
import platform
import re
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from typing import IO, Any, BinaryIO, NoReturn

import numpy as np

from sb3_kfcv.saving.files import atomic_write
from sb3_kfcv.saving.values import ARRAY_KINDS, decode, encode
from sb3_kfcv.version import __version__

FORMAT = "sb3-kfcv"
FORMAT_VERSION = 1
LIBRARIES = ("stable_baselines3", "torch", "numpy", "gymnasium", "pettingzoo", "numba", "scipy")

MANIFEST = "manifest.json"
MEMBER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_][A-Za-z0-9_.\-]*)*")
# The start of a .npy member, as numpy writes it: numbers or booleans, little-endian, in C order.
NPY_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][%s][1248])', 'fortran_order': False, "
    rb"'shape': \(((?:\d{1,18}, ?)*\d{0,18})\), \} *\n" % ARRAY_KINDS.encode(),
    re.DOTALL,
)
SEAL = b"sha256:"  # the archive comment: this, and 64 hexadecimal digits
SEAL_SIZE = len(SEAL) + 64
LOCAL_HEADER = 30  # bytes that stand before a member's name and data in a zip
CHUNK = 1 << 20  # bytes
UNREADABLE = (zipfile.BadZipFile, ValueError, OSError, EOFError, RuntimeError, MemoryError)  # what reading it may raise
LONGEST_MESSAGE = 400  # characters: what a file says of itself may be of any length

Source = str | pathlib.Path | io.BufferedIOBase | BinaryIO


class FileFormatError(ValueError):
    """A file that is damaged, crafted, or of another kind; the message names the file, and the member where there is one."""


@cache
def library_versions() -> dict[str, str]:
    """Versions of Python, of this package and of the libraries that it stands on."""
    return {"python": platform.python_version(), "sb3_kfcv": __version__} | {name: version(name) for name in LIBRARIES}


def write_archive(target: Source, kind: str, sections: Mapping[str, Any]) -> str:
    """
    Write a file: whole, or not at all.

    :param target: path, or an open file
    :param kind: what it holds: ``"model"``, ``"checkpoint"``, …
    :param sections: name → value, see :mod:`sb3_kfcv.saving.values`
    :return: its SHA-256, which is also its last 64 characters
    :raises UnwritableError: for a value that no file can hold
    """
    documents, arrays = {}, {}
    for name, value in sections.items():
        document, own = _encoded(name, value)
        documents[f"{name}.json"] = _to_json(document)
        arrays.update(own)
    if isinstance(target, (str, pathlib.Path)):
        with atomic_write(target) as file:
            return _write(file, kind, documents, arrays)
    buffer = io.BytesIO()
    digest = _write(buffer, kind, documents, arrays)
    target.write(buffer.getbuffer())
    return digest


def _encoded(section: str, value: Any) -> tuple[Any, dict[str, np.ndarray]]:
    arrays: dict[str, np.ndarray] = {}

    def store(place: str, array: np.ndarray) -> str:
        stem = "/".join(re.sub(r"[^A-Za-z0-9_.\-]", "_", part[:100]).lstrip(".-") or "_" for part in place.split("/"))
        name = f"{stem}.npy"
        while name in arrays:
            name = f"{name.removesuffix('.npy')}_.npy"
        arrays[name] = array
        return name

    return encode(value, section, store), arrays


def _to_json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False, indent=1).encode("utf-8")


def _write(file: BinaryIO, kind: str, documents: dict[str, bytes], arrays: dict[str, np.ndarray]) -> str:
    members: dict[str, dict[str, Any]] = {}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, text in documents.items():
            members[name] = _write_member(archive, name, text)
        for name, array in arrays.items():
            header = io.BytesIO()
            array = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False)).reshape(array.shape)
            np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(array))
            members[name] = _write_member(archive, name, header.getvalue(), array.reshape(-1).view(np.uint8).data)
        manifest = {
            **{"format": FORMAT, "format_version": FORMAT_VERSION, "kind": kind},
            **{"libraries": library_versions(), "members": members},
        }
        _write_member(archive, MANIFEST, _to_json(manifest))
        archive.comment = SEAL + b"0" * 64
    file.seek(0)
    digest = _digest_of_rest(file, file.seek(0, os.SEEK_END) - 64)
    file.seek(-64, os.SEEK_END)
    file.write(digest.encode())
    return digest


def _write_member(archive: zipfile.ZipFile, name: str, *parts: Any) -> dict[str, Any]:
    info = zipfile.ZipInfo(name)  # of 1980: equal contents make equal files
    info.file_size = sum(len(part) for part in parts)
    digest = hashlib.sha256()
    with archive.open(info, "w", force_zip64=info.file_size > 2**31 - 1) as member:
        for part in parts:
            for start in range(0, len(part), CHUNK):
                piece = part[start : start + CHUNK]
                member.write(piece)
                digest.update(piece)
    return {"bytes": info.file_size, "sha256": digest.hexdigest()}


def _digest_of_rest(file: IO[bytes], size: int) -> str:
    """SHA-256 of the first ``size`` bytes."""
    digest = hashlib.sha256()
    file.seek(0)
    while size > 0 and (piece := file.read(min(CHUNK, size))):
        digest.update(piece)
        size -= len(piece)
    return digest.hexdigest()


class Archive:
    """
    A file that was found whole: its checksum fits, and it holds what its manifest says, no more.

    :param file: open for reading
    :param name: of the file, for messages
    :param kinds: kinds of files that are wanted
    :raises FileFormatError: if it is damaged, of another kind, or no such file at all
    """

    def __init__(self, file: BinaryIO, name: str, kinds: Collection[str]) -> None:
        self.name = name
        self._file = file
        self._size = file.seek(0, os.SEEK_END)
        self.digest = self._check_seal()
        try:
            self._zip = zipfile.ZipFile(file)
        except UNREADABLE as error:
            self.refuse(f"is damaged: {error}")
        self._check_members(self._zip)
        self._members = {info.filename: info for info in self._zip.infolist()}
        self.manifest = self._read_json(MANIFEST)
        self._check_manifest(kinds)
        self.kind: str = self.manifest["kind"]

    def refuse(self, what: str) -> NoReturn:
        """
        :raises FileFormatError: always, with the name of the file
        """
        what = " ".join(what.split())
        raise FileFormatError(f"{self.name} {what[:LONGEST_MESSAGE]}{'…' * (len(what) > LONGEST_MESSAGE)}") from None

    def __contains__(self, section: str) -> bool:
        return f"{section}.json" in self._members

    def read(self, section: str, without: Collection[str] = ()) -> Any:
        """
        The value of a section.

        :param section: its name
        :param without: names to leave out of it, undecoded, if it is a map
        :raises FileFormatError: if there is no such section, or it holds what no section may hold
        """
        if section not in self:
            self.refuse(f'lacks the section "{section}"')
        plain = self._read_json(f"{section}.json")
        if without and isinstance(plain, dict):
            plain = {key: value for key, value in plain.items() if key not in without}
        read: set[str] = set()

        def fetch(name: str) -> np.ndarray:
            if name in read:  # a file must not unfold to more than its size
                raise ValueError(f"the array {name!r} stands in it twice")
            read.add(name)
            return self._read_array(name)

        with self._naming(f"{section}.json"):
            return decode(plain, section, fetch)

    @contextmanager
    def _naming(self, member: str) -> Iterator[None]:
        """Whatever goes wrong is told with the names of file and member."""
        try:
            yield
        except FileFormatError:
            raise
        except RecursionError:
            self.refuse(f"holds values nested too deeply: {member}")
        except UNREADABLE as error:
            self.refuse(f"cannot be read: {member}: {error}")

    def _check_seal(self) -> str:
        """Compare all bytes with the checksum at the end: that checksum."""
        self._file.seek(max(self._size - SEAL_SIZE, 0))
        seal = self._file.read(SEAL_SIZE)
        if not seal.startswith(SEAL):
            self.refuse(self._what_else())
        digest = _digest_of_rest(self._file, self._size - 64)
        if digest.encode() != seal[len(SEAL) :]:
            self.refuse(f"is damaged: {self._what_is_damaged()}")
        return digest

    def _what_else(self) -> str:
        """What a file without the seal at its end is."""
        try:
            with zipfile.ZipFile(self._file) as archive:
                names = archive.namelist()
        except UNREADABLE:
            names = []
        if "_stable_baselines3_version" in names:
            return (
                "is a file of Stable-Baselines3's own save(); it may hold code, which is not run here. "
                "Load it with stable_baselines3 where you trust it, and carry its weights over with set_parameters"
            )
        self._file.seek(0)
        if self._file.read(4) == b"PK\x03\x04":
            return f"is no {FORMAT} file, or it is damaged: its end (the archive comment with the checksum) is missing"
        return f"is no {FORMAT} file"

    def _what_is_damaged(self) -> str:
        """Which member does not fit its checksum."""
        suspect = "the zip directory, or the checksum at the end"
        try:
            with zipfile.ZipFile(self._file) as archive:
                self._check_members(archive)
                suspect = MANIFEST
                for name, entry in json.loads(archive.read(MANIFEST))["members"].items():
                    suspect = name
                    with archive.open(name) as member:
                        if _digest_of_rest(member, archive.getinfo(name).file_size) != entry["sha256"]:
                            return name
            return "the zip directory, or the checksum at the end"
        except (*UNREADABLE, KeyError, TypeError, AttributeError):
            return suspect

    def _check_members(self, archive: zipfile.ZipFile) -> None:
        infos = archive.infolist()
        if len(set(archive.namelist())) != len(infos):
            self.refuse("holds a member twice")
        for info in infos:
            plain = (
                info.compress_type == zipfile.ZIP_STORED and info.compress_size == info.file_size and not info.flag_bits & 1
            )
            if not plain or not MEMBER.fullmatch(info.orig_filename):
                self.refuse(f"holds a member that is not allowed: {info.orig_filename!r}")
        end = 0
        for info in sorted(infos, key=lambda info: info.header_offset):
            if info.header_offset < end:
                self.refuse(f"claims more than it holds: {info.filename} lies inside of another member")
            end = info.header_offset + LOCAL_HEADER + len(info.filename) + info.file_size
        if end > self._size:
            self.refuse("claims more than it holds")
        if MANIFEST not in archive.namelist():
            self.refuse(f"lacks {MANIFEST}")

    def _check_manifest(self, kinds: Collection[str]) -> None:
        manifest = self.manifest
        if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
            self.refuse(f"is no {FORMAT} file: {MANIFEST} says otherwise")
        found = manifest.get("format_version")
        if type(found) is not int or not 1 <= found <= FORMAT_VERSION:
            self.refuse(f"has format version {found!r}; this version of {FORMAT} reads 1 to {FORMAT_VERSION}: update it")
        if manifest.get("kind") not in kinds:
            self.refuse(f"is a {manifest.get('kind')!r} file; wanted is {' or '.join(kinds)}")
        claimed = manifest.get("members")
        sizes = {name: info.file_size for name, info in self._members.items() if name != MANIFEST}
        if not isinstance(claimed, dict) or set(claimed) != set(sizes):
            self.refuse(f"holds other members than {MANIFEST} says")
        for name, entry in claimed.items():
            if not isinstance(entry, dict) or entry.get("bytes") != sizes[name]:
                self.refuse(f"is damaged: {name} has another size than {MANIFEST} says")

    def _read_json(self, name: str) -> Any:
        def no_constant(text: str) -> NoReturn:
            raise ValueError(f"{text} is no JSON number")

        with self._naming(name):
            return json.loads(self._zip.read(name).decode("utf-8"), parse_constant=no_constant)

    def _read_array(self, name: str) -> np.ndarray:
        if not isinstance(name, str) or not name.endswith(".npy") or name not in self._members:
            raise ValueError(f"there is no array {name!r}")
        with self._naming(name), self._zip.open(name) as member:
            start = member.read(10)
            header = NPY_HEADER.fullmatch(start + member.read(int.from_bytes(start[8:], "little")))
            if header is None:
                raise ValueError("it does not begin as an array of numbers does (npy 1.0, C order)")
            dtype, shape = np.dtype(header[1].decode()), tuple(int(axis) for axis in re.findall(rb"\d+", header[2]))
            size = self._members[name].file_size - member.tell()
            if math.prod(shape) * dtype.itemsize != size:
                raise ValueError(f"its header says {shape} of {dtype}, its size {size} bytes")
            array = np.empty(shape, dtype)
            view = array.reshape(-1).view(np.uint8).data
            filled = 0
            while filled < size and (count := member.readinto(view[filled : filled + CHUNK])):  # type: ignore[attr-defined]
                filled += count
            if filled < size or member.read(1):
                raise ValueError("it is cut off")
            return array


@contextmanager
def open_archive(source: Source, *kinds: str) -> Iterator[Archive]:
    """
    Open a file for reading, and check it as a whole.

    :param source: path, or an open file
    :param kinds: kinds of files that are wanted
    :raises FileNotFoundError: if there is none
    :raises FileFormatError: if it is damaged, of another kind, or no such file at all
    """
    if isinstance(source, (str, pathlib.Path)):
        with open(source, "rb") as file:
            yield Archive(file, str(source), kinds)
    else:
        yield Archive(io.BytesIO(source.read()), str(getattr(source, "name", "the open file")), kinds)
