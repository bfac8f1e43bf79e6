"""Create a copy of a RayJob in the namespace of this pod. The name of the copy ends with the date.

    python start_rayjob.py NAME

The program needs only the standard library. It uses the account of the pod. A copy of today is not created twice.
"""

import json
import os
import ssl
import sys
import urllib.error
import urllib.request
from datetime import UTC, datetime
from pathlib import Path

ACCOUNT = Path(os.environ.get("ACCOUNT_DIRECTORY", "/var/run/secrets/kubernetes.io/serviceaccount"))
SERVER = os.environ.get("API_SERVER", "https://kubernetes.default.svc")
CLUSTER_SECONDS, JOB_SECONDS = 300, 7 * 24 * 3600  # time until KubeRay deletes the Ray cluster and the RayJob


def call_api(method: str, path: str, body: dict | None = None) -> dict:
    """Send a request to the API server of Kubernetes, and return the answer."""
    context = ssl.create_default_context(cafile=ACCOUNT / "ca.crt") if SERVER.startswith("https://") else None
    request = urllib.request.Request(f"{SERVER}{path}", json.dumps(body).encode() if body else None, method=method)
    request.add_header("Authorization", f"Bearer {(ACCOUNT / 'token').read_text()}")
    request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=30, context=context) as answer:
        return json.load(answer)


def make_copy(rayjob: dict, name: str) -> dict:
    """Return a new RayJob with the specification and the labels of a RayJob.

    KubeRay deletes the Ray cluster of the copy after five minutes and the copy after a week. KubeRay refuses these
    rules together with shutdownAfterJobFinishes.
    """
    rules = [
        {"policy": policy, "condition": {field: status, "ttlSeconds": seconds}}
        for field, status in (("jobStatus", "SUCCEEDED"), ("jobStatus", "FAILED"), ("jobDeploymentStatus", "Failed"))
        for policy, seconds in (("DeleteCluster", CLUSTER_SECONDS), ("DeleteSelf", JOB_SECONDS))
    ]
    replaced = ("shutdownAfterJobFinishes", "ttlSecondsAfterFinished", "jobId", "suspend")
    spec = {key: value for key, value in rayjob["spec"].items() if key not in replaced}
    metadata = {"name": name, "labels": rayjob["metadata"].get("labels", {})}
    return {
        "apiVersion": rayjob["apiVersion"],
        "kind": rayjob["kind"],
        "metadata": metadata,
        "spec": spec | {"deletionStrategy": {"deletionRules": rules}},
    }


def main(name: str) -> None:
    """Create the copy of today."""
    folder = f"/apis/ray.io/v1/namespaces/{(ACCOUNT / 'namespace').read_text().strip()}/rayjobs"
    today = f"{name}-{datetime.now(UTC):%Y%m%d}"
    try:
        call_api("POST", folder, make_copy(call_api("GET", f"{folder}/{name}"), today))
    except urllib.error.HTTPError as error:
        if error.code == 409:
            print(f"RayJob {today} exists already")
            return
        if error.code == 404:
            sys.exit(f"RayJob {name} does not exist; apply the stage {name} first")
        sys.exit(f"{error}: {error.read(2000).decode(errors='replace')}")
    print(f"created RayJob {today}")


if __name__ == "__main__":
    main(sys.argv[1])
