"""Check that all nodes of a Ray cluster write to the storage that the driver reads."""

from __future__ import annotations

import secrets
from collections.abc import Collection
from contextlib import suppress
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from pipelines.runtime import provenance, storage

MARKER = ".node-"  # Begin of the names of markers.
NODE_TIMEOUT_S = 120.0  # Longest time that a node may take to write its marker; a new worker process imports packages.


def require_shared_storage(output: str, checked: Collection[str] = ()) -> set[str]:
    """Check that each node writes files that the driver can read, and that all nodes run the same code.

    Each node writes a marker to the output. The driver reads the markers and deletes them.

    Args:
        output: Directory or URI to which tasks will write.
        checked: Ids of nodes that need no check.

    Returns:
        Ids of all nodes of the cluster, which have passed the check.

    Raises:
        ValueError: A node writes elsewhere, cannot write, does not answer or runs another version of the package. The
            message names the node and the remedy.
    """
    alive = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
    nodes = {name: node for name, node in alive.items() if name not in checked}
    token = secrets.token_hex(8)
    markers = {node: storage.join_uri(output, f"{MARKER}{token}-{node}") for node in nodes}
    write = ray.remote(num_cpus=0, max_retries=3)(write_marker)
    tasks = {
        node: write.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(marker, token)
        for node, marker in markers.items()
    }
    try:
        for node, task in tasks.items():
            _require_marker(output, markers[node], token, nodes[node], task)
    finally:
        # The tasks are not cancelled: if a task ends in the same moment, `ray.cancel` ends the driver (Ray 2.60).
        for marker in markers.values():
            with suppress(OSError):  # Where nothing can be written, an error here would hide the first one.
                storage.delete_file(marker)
    return set(alive)


def _find_node_name(node: dict[str, Any]) -> str:
    return f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']}, {node['NodeID'][:8]})"


def write_marker(marker: str, token: str) -> str:
    """Write a marker in a Ray task; return the digest of the code on this node."""
    storage.write_text(token, marker)
    return provenance.digest_code()


def _require_marker(output: str, marker: str, token: str, node: dict[str, Any], task: Any) -> None:
    """Raise ValueError if the marker of a node is not there or the node runs other code."""
    name = _find_node_name(node)
    try:
        digest = ray.get(task, timeout=NODE_TIMEOUT_S)
    except GetTimeoutError as error:
        raise ValueError(
            f"{name} did not write to {output} within {NODE_TIMEOUT_S:.0f} s; check its connection to the storage, or"
            " remove the node"
        ) from error
    except RayTaskError as error:
        cause = error.cause
        if isinstance(cause, OSError):
            raise ValueError(f"{name}: {cause}") from error
        raise ValueError(
            f"{name} cannot run this package ({cause or error}); install the same version on all nodes, or submit the"
            " job with --runtime-env infra/runtime_env.yaml"
        ) from error
    except RayError as error:
        if any(other["NodeID"] == node["NodeID"] and other["Alive"] for other in ray.nodes()):
            raise ValueError(f"{name} cannot run tasks ({error}); see its logs, or remove the node") from error
        return  # The node left the cluster; no task will run there.
    if not storage.exists(marker) or storage.read_bytes(marker) != token.encode():
        raise ValueError(
            f"{name} does not share {output} with the driver: a file that it wrote there is not visible here; use a"
            " directory that all nodes mount, such as NFS, or object storage (s3://bucket/...)"
        )
    if digest != provenance.digest_code():
        raise ValueError(
            f"{name} runs another version of this package; install the same version on all nodes, or submit the job"
            " with --runtime-env infra/runtime_env.yaml"
        )
