"""Tests of URIs: splitting, joining, options and errors."""

import pytest

from models.uris import is_uri, join_uri, parse_s3_options, resolve_uri, split_name, split_options

URI = "s3://bucket/folder?endpoint_override=http://127.0.0.1:9&region=x"


def test_join_keeps_options_at_the_end():
    assert join_uri(URI, "a", "b.json") == "s3://bucket/folder/a/b.json?endpoint_override=http://127.0.0.1:9&region=x"
    assert join_uri("s3://bucket/", "a") == "s3://bucket/a"
    assert join_uri("/data/", "a?b") == "/data/a?b"


def test_split_name_inverts_join():
    for place in (URI, "s3://bucket/folder", "/data/folder"):
        assert split_name(join_uri(place, "part")) == (place, "part")
    assert split_options("/data/what?") == ("/data/what?", "")
    assert is_uri(URI) and not is_uri("s3:/bucket")


def test_s3_options_reach_the_file_system(monkeypatch):
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    file_system, path = resolve_uri(join_uri(URI + "&anonymous=true", "x"))
    assert path == "bucket/folder/x" and file_system.region == "x"
    assert parse_s3_options("endpoint_override=http://a:1&anonymous=True") == {
        "endpoint_override": "a:1",
        "scheme": "http",
        "anonymous": True,
    }
    assert parse_s3_options("region=x", "https://b:2") == {"region": "x", "endpoint_override": "b:2", "scheme": "https"}


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("s3://key:secret@bucket/x", "must not contain credentials"),
        ("s3://key@bucket/x", "must not contain credentials"),
        ("s3://bucket/x?regoin=eu", "unknown option 'regoin'"),
        ("s3:/bucket/x", "a URI needs two slashes"),
        ("folder/gs:/bucket", "a URI needs two slashes"),
        ("ftp://host/x", "use a path or s3://"),
    ],
)
def test_bad_uri_is_refused_with_the_fix(uri, message):
    with pytest.raises(ValueError, match=message) as error:
        resolve_uri(uri)
    assert "secret" not in str(error.value)
