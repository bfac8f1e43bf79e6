"""Split and join URIs of files, and connect to object storage (s3://, gs://, abfss://).

A URI may carry options of the connection: s3://bucket/folder?endpoint_override=http://minio:9000&region=eu-west-1. All
functions keep these options. Local paths are accepted too.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from functools import lru_cache
from typing import Any
from urllib.parse import parse_qsl, urlsplit

# Options of an s3:// URI. The names are those of pyarrow.fs.S3FileSystem.
S3_OPTIONS = ("endpoint_override", "region", "scheme", "anonymous", "tls_ca_file_path")
OBJECT_STORES = ("s3", "gcs", "abfs")  # File systems of pyarrow whose writes replace a whole object in one request.
_BROKEN = re.compile(r"(^|/)(s3|gs|gcs|abfss?|https?):(/(?!/)|$)")  # a URI that lost a slash


def is_uri(path: str | os.PathLike) -> bool:
    """Return whether a path is a URI.

    Args:
        path: Path or URI, such as s3://bucket/folder.

    Returns:
        Whether it is a URI.
    """
    return "://" in os.fspath(path)


def split_options(uri: str) -> tuple[str, str]:
    """Split a URI into the part before its options and the options.

    Args:
        uri: URI or path.

    Returns:
        The part before the options; and the options, such as "?region=eu-west-1", or "" if there are none.
    """
    if not is_uri(uri):
        return uri, ""
    base, mark, options = uri.partition("?")
    return base, mark + options


def join_uri(uri: str | os.PathLike, *parts: str) -> str:
    """Join a URI or path with further parts, using slashes. The options of a URI are kept at its end.

    Args:
        uri: URI or path.
        *parts: Names or relative paths.

    Returns:
        URI or path.
    """
    base, options = split_options(os.fspath(uri))
    return "/".join([base.rstrip("/"), *parts]) + options


def split_name(uri: str) -> tuple[str, str]:
    """Split a URI or path into the directory and the name of the file.

    Args:
        uri: URI or path.

    Returns:
        URI, with its options, or path of the directory; and the name.
    """
    base, options = split_options(uri)
    directory, _, name = base.rstrip("/").rpartition("/")
    return directory + options, name


def resolve_local_path(path: str) -> str:
    """Return the absolute path of a local file, with the home directory for "~".

    Args:
        path: Path.

    Returns:
        Absolute path.

    Raises:
        ValueError: The path looks like a URI that lost a slash, such as s3:/bucket. It would become a local directory.
    """
    if match := _BROKEN.search(path):
        raise ValueError(f"{path}: a URI needs two slashes after {match[2]}:, as in {match[2]}://bucket/folder")
    return os.path.abspath(os.path.expanduser(path))


def resolve_uri(uri: str | os.PathLike) -> tuple[Any, str]:
    """Connect to the file system of a URI or of a local path.

    Args:
        uri: URI or path. Local paths are made absolute.

    Returns:
        File system (pyarrow.fs.FileSystem) and the path in this file system.

    Raises:
        ValueError: The URI has an unknown scheme or option, contains a password, or is damaged.
    """
    from pyarrow import fs as pafs  # imported here because models/ does not need pyarrow for local paths

    uri = os.fspath(uri)
    if not is_uri(uri):
        return pafs.LocalFileSystem(), resolve_local_path(uri)
    parts = urlsplit(uri)
    if parts.password or (parts.scheme == "s3" and "@" in parts.netloc):
        raise ValueError(
            f"{parts.scheme}://...@{parts.hostname}: a URI must not contain credentials, because URIs are written to"
            " logs and records; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY instead"
        )
    if parts.scheme == "s3":
        return connect_s3(parts.netloc, parts.query, _find_endpoint()), (parts.netloc + parts.path).rstrip("/")
    try:
        return pafs.FileSystem.from_uri(uri)
    except (ValueError, NotImplementedError) as error:
        raise ValueError(f"{uri}: cannot be used ({error}); use a path or s3://, gs:// or abfss://") from error


def _find_endpoint() -> str:
    """Return the endpoint that the environment states, or ""."""
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""


@lru_cache(maxsize=64)
def connect_s3(bucket: str, options: str, environment: str) -> Any:
    """Return the file system of all s3:// URIs with this bucket and these options.

    Args:
        bucket: Bucket, whose region is looked up if neither the options nor the environment state a region.
        options: Options after the "?" of a URI.
        environment: Endpoint from $AWS_ENDPOINT_URL, used if the options have none; may be empty.

    Returns:
        File system (pyarrow.fs.S3FileSystem).

    Raises:
        ValueError: An option is unknown.
    """
    from pyarrow import fs as pafs

    settings = parse_s3_options(options, environment)
    if not {"region", "endpoint_override"} & set(settings) and not (
        os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    ):
        with suppress(OSError):  # The first access to the bucket reports the reason.
            settings["region"] = pafs.resolve_s3_region(bucket)
    # Without a delayed opening, each file takes three writing requests: those of a multipart upload.
    return pafs.S3FileSystem(**settings, allow_delayed_open=True)


def parse_s3_options(options: str, environment: str = "") -> dict[str, Any]:
    """Convert the options of an s3:// URI to arguments of pyarrow.fs.S3FileSystem.

    Args:
        options: Options after the "?" of a URI, such as "endpoint_override=http://minio:9000".
        environment: Endpoint from $AWS_ENDPOINT_URL, used if the options have none; may be empty.

    Returns:
        Keyword arguments.

    Raises:
        ValueError: An option is unknown.
    """
    found: dict[str, Any] = dict(parse_qsl(options, keep_blank_values=True))
    if unknown := sorted(set(found) - set(S3_OPTIONS)):
        raise ValueError(
            f"an s3:// URI has the unknown option {unknown[0][:40]!r}; expected some of {', '.join(S3_OPTIONS)}"
        )
    if "anonymous" in found:
        found["anonymous"] = found["anonymous"].lower() in ("1", "true", "yes")
    if endpoint := found.get("endpoint_override") or environment:
        scheme, mark, host = endpoint.rpartition("://")
        found["endpoint_override"] = host.rstrip("/")
        if mark:
            found.setdefault("scheme", scheme)
    return found


def connect_fsspec(uri: str) -> Any:
    """Connect to the object storage of a URI with fsspec, which sends conditional requests.

    Args:
        uri: URI with the scheme s3, gs, abfs or abfss.

    Returns:
        File system (fsspec.AbstractFileSystem).

    Raises:
        ValueError: The package for this kind of object storage is missing, or an option of the URI is unknown.
    """
    import fsspec  # a dependency of torch

    parts = urlsplit(uri)
    arguments: dict[str, Any] = {}
    if parts.scheme == "s3":
        options = parse_s3_options(parts.query, _find_endpoint())
        client = {"region_name": options.get("region")}
        if endpoint := options.get("endpoint_override"):
            client["endpoint_url"] = f"{options.get('scheme', 'https')}://{endpoint}"
        if authorities := options.get("tls_ca_file_path"):
            client["verify"] = authorities
        # A hung endpoint is reported after about a minute.
        limits = {"connect_timeout": 10, "read_timeout": 20, "retries": {"max_attempts": 2}}
        arguments = {"anon": bool(options.get("anonymous")), "client_kwargs": client, "config_kwargs": limits}
    try:
        return fsspec.filesystem(parts.scheme, **arguments)
    except (ImportError, ValueError) as error:
        raise ValueError(
            f"{uri}: {error}; outputs in object storage need a package of fsspec: pip install 'pritti-on-ray[s3]',"
            " or gcsfs for gs://, or adlfs for abfss://"
        ) from error
