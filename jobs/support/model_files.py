"""Write the files of models."""

from __future__ import annotations

import os
import shutil
import tempfile
from typing import TYPE_CHECKING

from pipelines.runtime import storage

if TYPE_CHECKING:
    from models.pipeline import PrITTIPipeline


def write_pipeline(pipeline: PrITTIPipeline, output: str) -> None:
    """Write a pipeline to a directory or URI.

    Args:
        pipeline: Pipeline.
        output: Target directory or URI.

    Raises:
        ValueError: A file is not in the output, or has another size there.
    """
    with tempfile.TemporaryDirectory() as directory:
        pipeline.save_pretrained(directory)
        publish_directory(directory, output)


def publish_directory(directory: str, output: str) -> None:
    """Copy a saved model or pipeline file by file. The last files are those that mark a copy as complete.

    Args:
        directory: Local directory.
        output: Target directory or URI.

    Raises:
        ValueError: A file is not in the output, or has another size there.
    """
    paths = [
        os.path.relpath(os.path.join(top, name), directory) for top, _, names in os.walk(directory) for name in names
    ]
    for path in sorted(paths, key=lambda path: (path == "model_index.json", path.endswith("config.json"), path)):
        with open(os.path.join(directory, path), "rb") as source:
            storage.write_whole(
                storage.join_uri(output, path), lambda stream, source=source: shutil.copyfileobj(source, stream)
            )
    faults = {}
    for path in paths:
        target, expected = storage.join_uri(output, path), os.path.getsize(os.path.join(directory, path))
        if storage.measure_file_bytes(target) != expected:
            faults[target] = f"{target}: not the file of {expected:,} bytes that was written"
    storage.raise_faults(faults, len(paths))
