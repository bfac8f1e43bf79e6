"""Count the CPUs and GPUs of a cluster, ask its autoscaler for nodes, and wait for them.

The options --gpus and --wait-for-resources of the jobs set one ResourcePolicy per driver (`set_resource_policy`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import ray
from ray.exceptions import GetTimeoutError
from ray.util import placement_group, remove_placement_group

REPORT_S = 30.0  # Time between two lines about missing resources.
Resources = Mapping[str, float]


@dataclass(frozen=True)
class ResourcePolicy:
    """Resource options for all graphs of a driver.

    Attributes:
        gpus: Number of GPUs per model. None: 1 if the cluster has a GPU, otherwise 0.
        wait_s: Time to wait until the cluster has room, for example until an autoscaler has added nodes (s).
    """

    gpus: float | None = None
    wait_s: float = 0.0

    def __post_init__(self) -> None:
        if self.gpus is not None and (
            not 0 <= self.gpus < math.inf or (self.gpus > 1 and not float(self.gpus).is_integer())
        ):
            raise ValueError(f"--gpus is {self.gpus}, expected a whole number, or a share of a GPU from 0 to 1")
        if not 0 <= self.wait_s < math.inf:
            raise ValueError(f"--wait-for-resources is {self.wait_s}, expected a number of seconds of at least 0")


_policies: list[ResourcePolicy] = [ResourcePolicy()]  # The last entry is valid.


@contextmanager
def set_resource_policy(policy: ResourcePolicy) -> Iterator[None]:
    """Use a policy for all graphs that this driver runs in the body.

    Args:
        policy: Resource options.

    Yields:
        None.
    """
    _policies.append(policy)
    try:
        yield
    finally:
        _policies.pop()


def get_resource_policy() -> ResourcePolicy:
    """Return the policy of this driver.

    Returns:
        The policy of the innermost `set_resource_policy`.
    """
    return _policies[-1]


def count_gpus_per_model() -> float:
    """Return the number of GPUs per model.

    Returns:
        The number that the user asked for. Otherwise 1 if the cluster has a GPU, and 0 if it has none; the machine of
        the driver itself needs no GPU.
    """
    asked = get_resource_policy().gpus
    return float(ray.cluster_resources().get("GPU", 0) > 0) if asked is None else asked


def find_device() -> str:
    """Return the device for a model in this process.

    Returns:
        "cuda" if Ray assigned a GPU to this task or actor, or if torch finds a GPU in a process that is no task or
        actor; otherwise "cpu".

    Raises:
        ValueError: Ray assigned a GPU, but torch cannot use it. The model would be slow on the CPU without a message.
    """
    import torch  # the nodes that preprocess drives need no torch

    if ray.is_initialized() and ray.get_runtime_context().worker.mode == ray.WORKER_MODE:
        if not (assigned := ray.get_runtime_context().get_accelerator_ids().get("GPU")):
            return "cpu"
        if not torch.cuda.is_available():
            raise ValueError(
                f"node {ray.util.get_node_ip_address()}: Ray assigned GPU {', '.join(assigned)}, but torch"
                f" {torch.__version__} finds no CUDA device ({explain_missing_cuda()}); install torch with CUDA and a"
                " driver for it on this node, or use --gpus 0"
            )
        return "cuda"
    return "cuda" if torch.cuda.is_available() and get_resource_policy().gpus != 0 else "cpu"


def explain_missing_cuda() -> str:
    """Return torch's reason why it cannot use CUDA, such as a driver that is too old."""
    import torch

    try:
        torch.cuda.current_device()
    except (RuntimeError, AssertionError) as error:
        return str(error).partition(". ")[0]
    return "no reason is known"


def make_model_resources(num_cpus: float = 1.0) -> dict[str, float]:
    """Return the resources of an actor that holds a model.

    Args:
        num_cpus: Number of CPUs.

    Returns:
        CPUs and, if models use GPUs, GPUs.
    """
    gpus = count_gpus_per_model()
    return {"CPU": num_cpus} | ({"GPU": gpus} if gpus else {})


def count_room(need: Resources, spare: Resources | None = None) -> int:
    """Count the processes that fit on the nodes of the cluster, whether or not other jobs use these nodes.

    Args:
        need: Resources of one process, such as {"CPU": 1, "GPU": 0.5}.
        spare: Resources of another process that must also fit on one of the nodes.

    Returns:
        Number of processes.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]

    def fit(have: Resources) -> int:
        counts = [int((have.get(name, 0.0) + 1e-9) // value) for name, value in need.items() if value > 0]
        return min(counts, default=0)

    total = sum(map(fit, nodes))
    if not spare:
        return total
    losses = []  # Number of processes that a node loses if it keeps `spare` free.
    for have in nodes:
        left = {name: have.get(name, 0.0) - spare.get(name, 0.0) for name in {*have, *spare}}
        if all(value > -1e-9 for name, value in left.items() if name in spare):
            losses.append(fit(have) - fit(left))
    return total - min(losses) if losses else 0


def describe_resources(need: Resources) -> str:
    """Return resources as text.

    Args:
        need: Resources.

    Returns:
        Text such as "1 CPU and 0.5 GPU".
    """
    return " and ".join(f"{value:g} {name}" for name, value in need.items() if value) or "no resources"


def describe_cluster() -> str:
    """Return the CPUs and GPUs of the cluster as text.

    Returns:
        Text such as "2 nodes with 8 CPU and 1 GPU (free: 3 CPU)".
    """
    kinds = ("CPU", "GPU")
    have, free = ray.cluster_resources(), ray.available_resources()
    nodes = sum(node["Alive"] for node in ray.nodes())
    texts = [describe_resources({kind: part.get(kind, 0.0) for kind in kinds}) for part in (have, free)]
    return f"{nodes} node{'s' * (nodes != 1)} with {texts[0]} (free: {texts[1]})"


def require_room(
    need: Resources, count: int, what: str, spare: Resources | None = None, report: Callable[[str], None] = print
) -> int:
    """Wait until processes fit on the cluster, and ask the autoscaler for nodes meanwhile.

    Args:
        need: Resources of one process.
        count: Number of processes that must fit.
        what: Name of the processes for messages, such as "a worker of --num-workers".
        spare: Resources of another process that must also fit.
        report: Called with a line about what is missing, every REPORT_S.

    Returns:
        Number of processes that fit, at least `count`.

    Raises:
        ValueError: The cluster has no room within the time of the policy. The message names the missing resources and
            the remedy.
    """
    wait_s = get_resource_policy().wait_s
    end, reported = time.monotonic() + wait_s, -math.inf
    bundles = [dict(need) for _ in range(count)] + ([dict(spare)] if spare else [])
    group = None
    try:
        while (room := count_room(need, spare)) < count:
            if time.monotonic() >= end:
                after = f" after {wait_s:g} s" if wait_s else ""
                raise ValueError(
                    f"{what} needs {describe_resources(need)} {count} times, but this cluster has room for {room}"
                    f"{after}: {describe_cluster()}; ask for less, add nodes, or wait for an autoscaler with"
                    " --wait-for-resources SECONDS"
                )
            if group is None:  # A waiting group is a demand that the autoscaler sees.
                group = placement_group(bundles, strategy="PACK")
            if time.monotonic() - reported >= REPORT_S:
                report(f"waiting for {describe_resources(need)} {count} times ({what}): {describe_cluster()}")
                reported = time.monotonic()
            try:
                ray.get(group.ready(), timeout=min(1.0, max(0.1, end - time.monotonic())))
            except GetTimeoutError:
                continue
            time.sleep(0.1)  # The nodes are there. Their resources are listed in a moment.
    finally:
        if group is not None:
            remove_placement_group(group)
    return room
