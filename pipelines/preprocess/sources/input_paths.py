"""Paths of raw drives on a local disk or in object storage."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatch
from functools import total_ordering
from os import PathLike, fspath
from pathlib import Path, PurePosixPath

from models.local_copy import make_local_copy
from models.uris import is_uri, join_uri, split_name
from pipelines.runtime import storage


@total_ordering
class RemotePath:
    """A file or directory in object storage, with the methods of pathlib.Path that the readers of drives use."""

    def __init__(self, uri: str) -> None:
        self.uri = uri

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(join_uri(self.uri, name))

    def __str__(self) -> str:
        return self.uri

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemotePath) and self.uri == other.uri

    def __lt__(self, other: RemotePath) -> bool:
        return self.uri < other.uri

    def __hash__(self) -> int:
        return hash(self.uri)

    @property
    def name(self) -> str:
        """Name of the file or directory."""
        return split_name(self.uri)[1]

    @property
    def stem(self) -> str:
        """Name without the last suffix."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """Last suffix of the name, such as .json."""
        return PurePosixPath(self.name).suffix

    def exists(self) -> bool:
        """Return whether a file or directory exists."""
        return storage.exists(self.uri)

    def is_file(self) -> bool:
        """Return whether a file exists."""
        return storage.is_file(self.uri)

    def is_dir(self) -> bool:
        """Return whether a directory exists: some file has a name that begins with this path and a slash."""
        return self.exists() and not self.is_file()

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """Yield the files directly in this directory that match a pattern; "*/" yields the directories."""
        directories = pattern.endswith("/")
        for name in storage.list_names(self.uri, directories=directories):
            if fnmatch(name, pattern.rstrip("/")):
                yield self / name


InputPath = Path | RemotePath


def make_input_path(root: str | PathLike, *parts: str) -> InputPath:
    """Join a directory of raw drives with further parts.

    Args:
        root: Path or URI of the directory.
        *parts: Names.

    Returns:
        Path of a file or directory.
    """
    return RemotePath(join_uri(root, *parts)) if is_uri(root) else Path(fspath(root), *parts)


def find_local_file(path: InputPath) -> Path:
    """Return a local path with the content of a file; a file in object storage is copied to the local cache.

    Raises:
        ValueError: The file in object storage cannot be read. The message names the URI.
    """
    return Path(make_local_copy(path.uri)) if isinstance(path, RemotePath) else path
