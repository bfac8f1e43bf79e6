"""Extract the schemas of this folder from the CRDs of KubeRay and from the package kubernetes-validate.

    python extract_schemas.py KUBERAY_GIT_DIRECTORY KUBERNETES_VALIDATE_WHEEL

README.md names the versions. The script drops descriptions, versions of a CRD that no manifest uses, and definitions
that no manifest refers to. It keeps all types, required fields, enumerations, patterns and limits.
"""

import gzip
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import yaml

FOLDER = Path(__file__).parent
KUBERAY_TAG, KUBERNETES_VERSION = "v1.7.0", "v1.35.0"
CRDS = ("rayjobs", "rayclusters", "rayservices")
CORE_KINDS = (
    "configmap-v1",
    "cronjob-batch-v1",
    "deployment-apps-v1",
    "namespace-v1",
    "networkpolicy-networking-v1",
    "persistentvolumeclaim-v1",
    "role-rbac-v1",
    "rolebinding-rbac-v1",
    "service-v1",
    "serviceaccount-v1",
)
PREFIX = "/api/_definitions.json#/$defs/"


def drop_descriptions(schema: object, is_schema: bool = True) -> object:
    """Return a copy without the keyword `description`; a property of this name is kept."""
    if isinstance(schema, list):
        return [drop_descriptions(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: drop_descriptions(value, not (is_schema and key in ("properties", "$defs")))
        for key, value in schema.items()
        if not (is_schema and key == "description")
    }


def read_crd(git_directory: str, name: str) -> dict:
    """Return the schema of version v1 of a CRD."""
    path = f"{KUBERAY_TAG}:helm-chart/kuberay-operator/crds/ray.io_{name}.yaml"
    shown = subprocess.run(["git", f"--git-dir={git_directory}", "show", path], check=True, capture_output=True)
    crd = yaml.load(shown.stdout, Loader=yaml.CSafeLoader)
    (version,) = [version for version in crd["spec"]["versions"] if version["name"] == "v1"]
    assert version["served"]
    return version["schema"]["openAPIV3Schema"]


def list_references(schema: object) -> set[str]:
    """Return the names of the definitions that a schema refers to."""
    if isinstance(schema, list):
        return set().union(*map(list_references, schema))
    if not isinstance(schema, dict):
        return set()
    own = {schema["$ref"].rpartition("/")[2]} if isinstance(schema.get("$ref"), str) else set()
    return own.union(*map(list_references, schema.values()))


def read_core_schemas(wheel: str) -> dict:
    """Return {"kinds": {"v1/Service": schema}, "$defs": {name: schema}}."""
    folder = f"kubernetes_validate/kubernetes-json-schema/{KUBERNETES_VERSION}-local"
    with zipfile.ZipFile(wheel) as archive:
        definitions = json.loads(archive.read(f"{folder}/_definitions.json"))["$defs"]
        files = [json.loads(archive.read(f"{folder}/{name}.json")) for name in CORE_KINDS]
    kinds = {}
    for schema in files:
        (version,), (kind,) = (schema["properties"][name]["enum"] for name in ("apiVersion", "kind"))
        kinds[f"{version}/{kind}"] = schema
    needed, added = set(), list_references(files)
    while added:
        needed |= added
        added = set().union(*(list_references(definitions[name]) for name in added)) - needed
    return {"kinds": kinds, "$defs": {name: definitions[name] for name in sorted(needed)}}


def write_json(value: object, name: str) -> None:
    """Write a gzip-compressed JSON file; the same value gives the same bytes."""
    text = json.dumps(drop_descriptions(value), sort_keys=True, separators=(",", ":"))
    text = text.replace(PREFIX, "#/$defs/")
    (FOLDER / name).write_bytes(gzip.compress(text.encode(), mtime=0))


if __name__ == "__main__":
    for crd in CRDS:
        write_json(read_crd(sys.argv[1], crd), f"{crd}.json.gz")
    write_json(read_core_schemas(sys.argv[2]), "kubernetes.json.gz")
