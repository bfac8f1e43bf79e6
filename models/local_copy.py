"""Keep local, cached copies of files in object storage, for readers that need a local path.

The cache is the directory $PRITTI_CACHE (default: $XDG_CACHE_HOME/pritti or ~/.cache/pritti). A copy is found again by
the URI, size and modification time of its source, so a replaced source is copied again. Each copy has a SHA-256 digest,
computed while it is written. The digest is checked when a process uses the copy for the first time.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from models.limits import require_within
from models.uris import is_uri, join_uri, resolve_uri, split_options

CHUNK_BYTES = 2**20
NUM_THREADS = 8
_checked: set[Path] = set()  # Copies whose digest this process has checked.


def find_cache_directory(*parts: str) -> Path:
    """Return a directory in the local cache. The directory may be absent.

    Args:
        *parts: Names of nested directories.

    Returns:
        Absolute path.
    """
    base = os.environ.get("PRITTI_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "pritti"
    )
    return Path(os.path.abspath(base), *parts)


def make_local_copy(uri: str | os.PathLike, keep: Callable[[str], bool] | None = None) -> str:
    """Return a local path with the content of a file or directory.

    Args:
        uri: URI of a file or directory, or a local path. A local path is returned unchanged.
        keep: For a directory, a function that returns whether the file with this relative path is copied (default: all
            files).

    Returns:
        Local path. The files there must not be changed.

    Raises:
        ValueError: There is no such file, or it cannot be read. The message names the URI.
    """
    uri = os.fspath(uri)
    if not is_uri(uri):
        return uri
    from pyarrow import fs as pafs  # models/ needs pyarrow for URIs only

    file_system, path = resolve_uri(uri)
    try:
        info = file_system.get_file_info(path)
        if info.is_file:
            return str(_copy_file(file_system, info, uri))
        found = file_system.get_file_info(pafs.FileSelector(path, recursive=True, allow_not_found=True))
    except OSError as error:
        raise ValueError(f"{uri}: cannot be read ({error}); check the bucket, credentials and connection") from error
    files = [(entry.path[len(path) :].lstrip("/"), entry) for entry in found if entry.is_file]
    files = [(name, entry) for name, entry in files if keep is None or keep(name)]
    if not files:
        raise ValueError(f"{uri}: no such file or directory")
    for name, _ in files:
        if ".." in name.split("/"):
            raise ValueError(f"{uri}: the name {name[:80]!r} of an object leads out of its directory")
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        copies = list(pool.map(lambda file: _copy_file(file_system, file[1], join_uri(uri, file[0])), files))
    return str(_link_directory(uri, [name for name, _ in files], copies))


def _copy_file(file_system: Any, info: Any, uri: str) -> Path:
    """Copy a file to the cache if it is not there, and return its path."""
    key = _hash_values([split_options(uri), info.size, str(info.mtime_ns)])
    directory = find_cache_directory("files", key[:2], key)
    copy = directory / os.path.basename(info.path)
    if copy in _checked:
        return copy
    record = directory / ".sha256"
    if record.is_file() and copy.is_file():
        if record.read_text() == _hash_file(copy):
            _checked.add(copy)
            return copy
        shutil.rmtree(directory, ignore_errors=True)  # The copy is damaged.
    directory.mkdir(parents=True, exist_ok=True)
    temporary = directory / f".tmp-{secrets.token_hex(8)}"
    digest, size = hashlib.sha256(), 0
    try:
        with file_system.open_input_stream(info.path, compression=None) as source, temporary.open("wb") as target:
            while chunk := source.read(CHUNK_BYTES):
                require_within("copied_bytes", size := size + len(chunk), uri)
                digest.update(chunk)
                target.write(chunk)
        if size != info.size:
            raise ValueError(f"{uri}: {size:,} of {info.size:,} bytes were received; run the same command again")
        os.replace(temporary, copy)
        temporary.write_text(digest.hexdigest())
        os.replace(temporary, record)
    except OSError as error:
        raise ValueError(
            f"{uri}: cannot be copied to {directory} ({error}); check the connection, and the free space there or set"
            " PRITTI_CACHE to another directory"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
    _checked.add(copy)
    return copy


def _link_directory(uri: str, names: Sequence[str], copies: Sequence[Path]) -> Path:
    """Return a directory of the cache with links to the copies of files, under their relative paths."""
    key = _hash_values([split_options(uri), [str(copy) for copy in copies]])
    base, _ = split_options(uri)
    directory = find_cache_directory("directories", key[:2], key, base.rstrip("/").rsplit("/", 1)[-1])
    for name, copy in zip(names, copies, strict=True):
        link = directory / name
        link.parent.mkdir(parents=True, exist_ok=True)
        if not (link.is_symlink() and link.exists()):
            temporary = link.with_name(f".tmp-{secrets.token_hex(8)}")
            temporary.symlink_to(copy)
            os.replace(temporary, link)
    return directory


def _hash_values(values: list) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:32]


def _hash_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
