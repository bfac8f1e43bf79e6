"""Tests of the manifests in infra/kubernetes, of infra/Dockerfile and of .dockerignore.

The tests render the overlays and validate every document as the API server does with strict field validation. They need
neither Docker nor Kubernetes. tests/data/kuberay/README.md names the sources of the schemas.
"""

import functools
import gzip
import importlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from copy import deepcopy
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
import tyro
import yaml
from helpers import ROOT
from jsonschema import Draft202012Validator, ValidationError

from jobs.support.renames import find_renamed
from models.presets import DIT_PRESETS, LVAE_PRESETS

FOLDER, DATA = ROOT / "infra/kubernetes", ROOT / "tests/data/kuberay"
OVERLAYS = ("dev", "prod")
STAGES = ("preprocess", "train-lvae", "encode-latents", "train-dit", "sample", "evaluate")
# Objects that the user or Kubernetes creates. infra/kubernetes/README.md documents the Secrets.
EXTERNAL = {
    ("Secret", "bucket"),
    ("Secret", "studio"),
    ("ConfigMap", "kube-root-ca.crt"),
}
CLUSTERS = {"RayJob": ("spec", "rayClusterSpec"), "RayCluster": ("spec",), "RayService": ("spec", "rayClusterConfig")}
SUBMISSION_MODES = ("K8sJobMode", "HTTPMode", "InteractiveMode", "SidecarMode")
SECRET_NAME = re.compile(r"PASSWORD|SECRET|TOKEN|ACCESS_KEY|CREDENTIAL", re.I)

Field = tuple[str | int, ...]
Problem = tuple[Field, str]


# Rendering


@functools.cache
def find_renderer() -> list[str] | None:
    """Return the command of a renderer with Kustomize 5 or later: kubectl of the virtual environment or of the PATH."""
    installed = Path(sys.executable).parent / "kubectl"
    for name, words in ((str(installed), ["kustomize"]), ("kubectl", ["kustomize"]), ("kustomize", ["build"])):
        if program := shutil.which(name):
            options = ["version", "--client"] if words == ["kustomize"] else ["version"]
            shown = subprocess.run([program, *options], capture_output=True, text=True, timeout=30).stdout
            version = re.search(r"(?:Kustomize Version: |^)v(\d+)\.\d+", shown)
            if version and int(version[1]) >= 5:
                return [program, *words]
    return None


@functools.cache
def render(folder: str) -> list[dict]:
    """Return the documents of a folder under infra/kubernetes/overlays."""
    done = subprocess.run([*find_renderer(), str(FOLDER / "overlays" / folder)], capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr.decode()
    return [document for document in yaml.load_all(done.stdout, Loader=yaml.CSafeLoader) if document]


def require_renderer() -> None:
    """Skip a test if there is no renderer. In CI, the test fails instead."""
    if find_renderer() is None:
        reason = "no kubectl or kustomize with Kustomize 5: see infra/kubernetes/README.md"
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)


@pytest.fixture(scope="module")
def manifests() -> Callable[[str], list[dict]]:
    """Function that returns a copy of all documents of an overlay: services and stages."""
    require_renderer()
    return lambda overlay: deepcopy(render(overlay) + render(f"{overlay}/stages"))


# Schemas


def read_schema(name: str) -> dict:
    return json.loads(gzip.decompress((DATA / f"{name}.json.gz").read_bytes()))


def close_objects(schema: object, preserves_maps: bool) -> object:
    """Return a JSON schema that rejects unknown fields, as strict field validation does.

    Args:
        schema: OpenAPI schema.
        preserves_maps: Whether an object without properties may have any fields. In a CRD, it may have none.

    Returns:
        The closed schema. Fields with a default are not required, because the API server adds them.
    """
    if isinstance(schema, list):
        return [close_objects(item, preserves_maps) for item in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {key: close_objects(value, preserves_maps) for key, value in schema.items() if key != "properties"}
    is_object = "object" in (schema.get("type") or ())
    properties = schema.get("properties")
    if isinstance(properties, dict) and (is_object or "properties" in schema):
        closed["properties"] = {name: close_objects(value, preserves_maps) for name, value in properties.items()}
        if "required" in schema:
            closed["required"] = [name for name in schema["required"] if "default" not in properties.get(name, {})]
    is_open = schema.get("x-kubernetes-preserve-unknown-fields") or (preserves_maps and not properties)
    if is_object and "additionalProperties" not in schema and not is_open:
        closed["additionalProperties"] = False
    return closed


@functools.cache
def load_validators() -> dict[str, Draft202012Validator]:
    """Return a validator for each kind, by "apiVersion/kind"."""
    core = read_schema("kubernetes")
    definitions = {name: close_objects(schema, True) for name, schema in core["$defs"].items()}
    schemas = {}
    for kind, schema in core["kinds"].items():
        kept = {key: value for key, value in schema.items() if key not in ("$id", "$schema")}
        schemas[kind] = close_objects(kept, True)
    for kind, name in (("RayJob", "rayjobs"), ("RayCluster", "rayclusters"), ("RayService", "rayservices")):
        schemas[f"ray.io/v1/{kind}"] = close_objects(read_schema(name), False)
        metadata = {"$ref": "#/$defs/io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta"}
        schemas[f"ray.io/v1/{kind}"]["properties"]["metadata"] = metadata
    return {kind: Draft202012Validator(schema | {"$defs": definitions}) for kind, schema in schemas.items()}


def list_fields(error: ValidationError) -> list[Field]:
    """Return the fields that an error concerns; a missing or unknown field is part of its path."""
    path, names = tuple(error.absolute_path), []
    if error.validator == "required":
        names = [name for name in error.validator_value if name not in error.instance]
    elif error.validator == "additionalProperties":
        names = [name for name in error.instance if name not in error.schema.get("properties", {})]
    return [(*path, name) for name in names] or [path]


def check_schema(document: dict) -> Iterator[Problem]:
    """Yield the differences between a document and the schema of its kind."""
    kind = f"{document.get('apiVersion')}/{document.get('kind')}"
    if kind not in load_validators():
        yield ("kind",), f"no schema of {kind}"
        return
    for error in load_validators()[kind].iter_errors(document):
        for field in list_fields(error):
            yield field, error.message[:200]


# Rules that schemas do not contain


def get(value: object, *path: str | int) -> object:
    """Return the value at a path, or None if there is none."""
    for key in path:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def list_templates(document: dict) -> list[tuple[Field, dict]]:
    """Return the pod templates of a document with their paths."""
    paths: list[Field] = {
        "Deployment": [("spec", "template")],
        "CronJob": [("spec", "jobTemplate", "spec", "template")],
        "RayJob": [("spec", "submitterPodTemplate")],
    }.get(document["kind"], [])
    if start := CLUSTERS.get(document["kind"]):
        paths.append((*start, "headGroupSpec", "template"))
        groups = get(document, *start, "workerGroupSpecs") or []
        paths += [(*start, "workerGroupSpecs", k, "template") for k in range(len(groups))]
    return [(path, template) for path in paths if (template := get(document, *path))]


def list_containers(document: dict) -> list[tuple[Field, dict]]:
    """Return the containers of a document with their paths."""
    return [
        ((*path, "spec", kind, k), container)
        for path, template in list_templates(document)
        for kind in ("containers", "initContainers")
        for k, container in enumerate(get(template, "spec", kind) or [])
    ]


def read_documented_images() -> set[str]:
    """Return the image names with tags that infra/Dockerfile documents."""
    return set(re.findall(r"docker build .*?-t (\S+)", (ROOT / "infra/Dockerfile").read_text()))


def check_unprivileged(context: dict | None) -> Iterator[Problem]:
    """Yield the fields of a security context that do not make a container unprivileged."""
    wanted = {
        ("allowPrivilegeEscalation",): False,
        ("capabilities", "drop"): ["ALL"],
        ("capabilities", "add"): None,
        ("privileged",): None,
        ("runAsNonRoot",): True,
        ("seccompProfile", "type"): "RuntimeDefault",
    }
    for path, value in wanted.items():
        if get(context, *path) != value:
            yield path, f"is {get(context, *path)!r}, expected {value!r}"
    if not get(context, "runAsUser"):
        yield ("runAsUser",), "expected the id of a user that is not root"


def check_container(container: dict) -> Iterator[Problem]:
    """Yield problems of a container: image, privileges, ports of the host, texts that should be in a Secret."""
    if container.get("image") not in read_documented_images():
        yield ("image",), f"{container.get('image')!r} is not an image with a tag that infra/Dockerfile documents"
    for path, message in check_unprivileged(container.get("securityContext")):
        yield ("securityContext", *path), message
    for k, port in enumerate(container.get("ports", [])):
        if "hostPort" in port:
            yield ("ports", k, "hostPort"), "opens a port of the host"
    for k, variable in enumerate(container.get("env", [])):
        if SECRET_NAME.search(variable["name"]) and variable.get("value"):
            yield ("env", k, "value"), f"the value of {variable['name']} belongs in a Secret"
    for path in (("requests", "cpu"), ("requests", "memory"), ("limits", "memory")):
        if not get(container, "resources", *path):
            yield ("resources", *path), "is missing"


def check_pod(spec: dict, needs_account: bool) -> Iterator[Problem]:
    """Yield problems of a pod: namespaces and files of the host, the account, volumes that do not exist."""
    for name in ("hostNetwork", "hostPID", "hostIPC"):
        if spec.get(name):
            yield (name,), "shares a namespace of the host"
    if spec.get("automountServiceAccountToken") is not needs_account:
        yield ("automountServiceAccountToken",), f"expected {needs_account}"
    if spec.get("enableServiceLinks") is not False:
        yield ("enableServiceLinks",), "variables of the service mlflow would change options of MLflow"
    volumes = [volume["name"] for volume in spec.get("volumes", [])]
    for k, volume in enumerate(spec.get("volumes", [])):
        if "hostPath" in volume:
            yield ("volumes", k, "hostPath"), "mounts files of the host"
    for k, container in enumerate(spec.get("containers", [])):
        for m, mount in enumerate(container.get("volumeMounts", [])):
            if mount["name"] not in volumes:
                yield ("containers", k, "volumeMounts", m, "name"), f"no volume {mount['name']!r}"


def check_workload(document: dict) -> Iterator[Problem]:
    """Yield problems of the pods of a document."""
    for path, template in list_templates(document):
        for field, message in check_pod(template["spec"], needs_account=document["kind"] == "CronJob"):
            yield (*path, "spec", *field), message
    for path, container in list_containers(document):
        for field, message in check_container(container):
            yield (*path, *field), message


def check_service(document: dict) -> Iterator[Problem]:
    """Yield problems of a Service, a Secret or a ConfigMap."""
    if document["kind"] == "Service" and document["spec"].get("type", "ClusterIP") != "ClusterIP":
        yield ("spec", "type"), "makes the service reachable from outside Kubernetes"
    if document["kind"] == "Secret":
        yield ("kind",), "the repository must not contain a Secret"
    if document["kind"] == "ConfigMap":
        for name in document.get("data", {}):
            if SECRET_NAME.search(name):
                yield ("data", name), "belongs in a Secret"


def check_cluster(document: dict) -> Iterator[Problem]:
    """Yield problems of a Ray cluster that KubeRay or Ray would report: token, version, replicas, autoscaler."""
    start: Field | None = CLUSTERS.get(document["kind"])
    if start is None:
        return
    cluster = get(document, *start) or {}
    if get(cluster, "authOptions", "mode") != "token":
        yield (*start, "authOptions", "mode"), "the cluster has no token"
    if cluster.get("rayVersion") != read_ray_version():
        yield (*start, "rayVersion"), f"expected {read_ray_version()}, as in infra/constraints.txt"
    if get(cluster, "headGroupSpec", "serviceType") != "ClusterIP":
        yield (*start, "headGroupSpec", "serviceType"), "makes the head reachable from outside Kubernetes"
    if document["kind"] == "RayJob" and document["spec"].get("submissionMode") not in SUBMISSION_MODES:
        yield ("spec", "submissionMode"), f"expected one of {', '.join(SUBMISSION_MODES)}"
    for k, group in enumerate(cluster.get("workerGroupSpecs", [])):
        least, number, most = (group.get(name) for name in ("minReplicas", "replicas", "maxReplicas"))
        if not (isinstance(least, int) and isinstance(most, int) and 0 <= least <= (number or 0) <= most):
            message = f"expected 0 <= minReplicas {least} <= replicas {number} <= maxReplicas {most}"
            yield (*start, "workerGroupSpecs", k, "minReplicas"), message
    if cluster.get("enableInTreeAutoscaling"):
        for field, message in check_unprivileged(get(cluster, "autoscalerOptions", "securityContext")):
            yield (*start, "autoscalerOptions", "securityContext", *field), message


def read_ray_version() -> str:
    return re.search(r"^ray==(\S+)$", (ROOT / "infra/constraints.txt").read_text(), re.M)[1]


def parse_entrypoint(entrypoint: str, home: str) -> tuple[str, object]:
    """Return the job of an entrypoint and its options, parsed by the parser of the job.

    Raises:
        ValueError: The entrypoint is no valid command of a job.
    """
    words = shlex.split(entrypoint.replace("$PRITTI_HOME", home))
    if not words or not re.fullmatch(r"jobs/\w+\.py", words[0]) or not (ROOT / words[0]).is_file():
        raise ValueError(f"{entrypoint!r} does not start with a file of jobs/")
    job = Path(words[0]).stem
    if renamed := find_renamed(job, words[1:]):
        raise ValueError(renamed)
    options = importlib.import_module(f"jobs.{job}")
    default = {"default": options.DEFAULT} if hasattr(options, "DEFAULT") else {}
    try:
        return job, tyro.cli(options.Config, args=words[1:], console_outputs=False, **default)
    except SystemExit as error:
        raise ValueError(f"{entrypoint!r} is no valid command of {words[0]}") from error


def check_entrypoint(document: dict) -> Iterator[Problem]:
    """Yield problems of the command of a RayJob, and of the cluster that the command needs when it starts."""
    if document["kind"] != "RayJob":
        return
    try:
        job, options = parse_entrypoint(document["spec"].get("entrypoint", ""), "/home")
    except ValueError as error:
        yield ("spec", "entrypoint"), str(error)
        return
    groups = get(document, "spec", "rayClusterSpec", "workerGroupSpecs") or []
    replicas = "maxReplicas" if getattr(options, "wait_for_resources_s", 0) else "minReplicas"
    gpus = sum(
        int(get(group, "template", "spec", "containers", 0, "resources", "limits", "nvidia.com/gpu") or 0)
        * group.get(replicas, 0)
        for group in groups
    )
    if any(group.get("groupName") == "gpu" for group in groups) and gpus < getattr(options, "num_workers", 1):
        message = f"--num-workers is {getattr(options, 'num_workers', 1)}, but {replicas} give {gpus} GPUs"
        yield ("spec", "entrypoint"), message
    if options.if_busy != "wait":
        yield ("spec", "entrypoint"), "without --if-busy wait, the lease of a lost head refuses the repeated job"
    if gpus and not getattr(options, "gpus", None):
        yield ("spec", "entrypoint"), "without --gpus, the job runs on CPUs if no GPU node runs when it starts"
    if job in ("train_lvae", "train_dit"):
        preset = (LVAE_PRESETS if job == "train_lvae" else DIT_PRESETS)[options.preset]
        if (options.batch_size or preset.batch_size) % options.num_workers:
            yield ("spec", "entrypoint"), f"--num-workers {options.num_workers} does not divide the batch size"


def list_references(template: dict) -> Iterator[tuple[Field, str, str]]:
    """Yield the path, the kind and the name of each object that a pod needs."""
    spec = template["spec"]
    if "serviceAccountName" in spec:
        yield ("serviceAccountName",), "ServiceAccount", spec["serviceAccountName"]
    for k, volume in enumerate(spec.get("volumes", [])):
        sources = [((), volume)]
        sources += [(("projected", "sources", m), s) for m, s in enumerate(get(volume, "projected", "sources") or [])]
        for path, source in sources:
            for field, kind, key in (
                ("persistentVolumeClaim", "PersistentVolumeClaim", "claimName"),
                ("configMap", "ConfigMap", "name"),
                ("secret", "Secret", "secretName"),
            ):
                if field in source:
                    yield ("volumes", k, *path, field, key), kind, source[field][key]
    for k, container in enumerate(spec.get("containers", [])):
        for m, source in enumerate(container.get("envFrom", [])):
            for field, kind in (("configMapRef", "ConfigMap"), ("secretRef", "Secret")):
                if field in source:
                    yield ("containers", k, "envFrom", m, field, "name"), kind, source[field]["name"]
        for m, variable in enumerate(container.get("env", [])):
            for field, kind in (("configMapKeyRef", "ConfigMap"), ("secretKeyRef", "Secret")):
                if reference := get(variable, "valueFrom", field):
                    yield ("containers", k, "env", m, "valueFrom", field, "name"), kind, reference["name"]


def check_references(document: dict, existing: set[tuple[str, str]]) -> Iterator[Problem]:
    """Yield references of pods to objects that neither the overlay nor the user creates."""
    for path, template in list_templates(document):
        for field, kind, name in list_references(template):
            if (kind, name) not in existing | EXTERNAL:
                yield (*path, "spec", *field), f"no {kind} {name!r}"
    if document["kind"] == "RoleBinding":
        references = [(("roleRef", "name"), document["roleRef"])]
        references += [(("subjects", k, "name"), one) for k, one in enumerate(document["subjects"])]
        for field, reference in references:
            if (reference["kind"], reference["name"]) not in existing:
                yield field, f"no {reference['kind']} {reference['name']!r}"


def check_selector(document: dict, labels: list[dict]) -> Iterator[Problem]:
    """Yield a selector of a Service or NetworkPolicy that selects no pod."""
    path = {"Service": ("spec", "selector"), "NetworkPolicy": ("spec", "podSelector", "matchLabels")}.get(
        document["kind"]
    )
    wanted = get(document, *path) if path else None
    if wanted and not any(wanted.items() <= one.items() for one in labels):
        yield path, f"no pod has the labels {wanted}"


def check_all(documents: list[dict]) -> list[str]:
    """Return all problems of the documents of an overlay, as "KIND NAME: FIELD: MESSAGE"."""
    existing = {(document["kind"], get(document, "metadata", "name")) for document in documents}
    labels = [
        get(template, "metadata", "labels") or {} for document in documents for _, template in list_templates(document)
    ]
    found = []
    for document in documents:
        problems = [*check_schema(document), *check_service(document), *check_workload(document)]
        problems += [*check_cluster(document), *check_entrypoint(document)]
        problems += [*check_references(document, existing), *check_selector(document, labels)]
        title = f"{document['kind']} {get(document, 'metadata', 'name')}"
        found += [f"{title}: {'.'.join(map(str, field))}: {message}" for field, message in problems]
    return found


# Tests


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_overlays_are_valid(overlay, manifests):
    assert check_all(manifests(overlay)) == []


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_overlays_contain_all_parts(overlay, manifests):
    documents = manifests(overlay)
    names = [(document["kind"], document["metadata"]["name"]) for document in documents]
    assert len(names) == len(set(names))
    assert {name for kind, name in names if kind == "RayJob"} == set(STAGES)
    for kind, name in (
        ("Deployment", "mlflow"),
        ("Deployment", "studio"),
        ("CronJob", "nightly-evaluation"),
        ("PersistentVolumeClaim", "mlflow"),
    ):
        assert (kind, name) in names
    (namespace,) = [name for kind, name in names if kind == "Namespace"]
    assert {document["metadata"].get("namespace", namespace) for document in documents} == {namespace}


def find(documents: list[dict], kind: str, name: str) -> dict:
    (document,) = [one for one in documents if (one["kind"], one["metadata"]["name"]) == (kind, name)]
    return document


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_policies_deny_by_default_and_admit_ray(overlay, manifests):
    """Every pod is selected by the policy that denies all connections. Ray admits its pods and the operator only."""
    documents = manifests(overlay)
    deny, ray = (find(documents, "NetworkPolicy", name)["spec"] for name in ("deny-ingress", "ray"))
    assert deny == {"podSelector": {}, "policyTypes": ["Ingress"]}
    own, operator = ray["ingress"]
    assert own == {"from": [{"podSelector": ray["podSelector"]}]}
    assert [port["port"] for port in operator["ports"]] == [8265]
    assert operator["from"][0]["podSelector"]["matchLabels"] == {"app.kubernetes.io/name": "kuberay-operator"}
    for stage in STAGES:
        for _, template in list_templates(find(documents, "RayJob", stage)):
            assert ray["podSelector"]["matchLabels"].items() <= template["metadata"]["labels"].items()


def parse_quantity(text: str) -> float:
    """Return a number of CPUs or a size in GiB."""
    number, unit = re.fullmatch(r"([\d.]+)(m|Mi|Gi|)", text).groups()
    return float(number) / {"m": 1000, "Mi": 1024, "Gi": 1, "": 1}[unit]


@pytest.mark.parametrize(("resource", "limit"), [("cpu", 3.5), ("memory", 14)])
def test_dev_fits_on_small_node(resource, limit, manifests):
    """The services and one stage fit on a node with 4 CPUs and 16 GiB, next to the pods of Kubernetes."""
    documents = [one for one in manifests("dev") if one["kind"] != "RayJob" or one["metadata"]["name"] == "train-dit"]
    requests = [c["resources"]["requests"][resource] for one in documents for _, c in list_containers(one)]
    assert sum(map(parse_quantity, requests)) <= limit


def test_dev_needs_one_node_without_gpu(manifests):
    documents = manifests("dev")
    assert "nvidia.com/gpu" not in json.dumps(documents) and "nodeSelector" not in json.dumps(documents)
    claims = [document["spec"] for document in documents if document["kind"] == "PersistentVolumeClaim"]
    assert all(claim["accessModes"] == ["ReadWriteOnce"] for claim in claims)
    assert find(documents, "ConfigMap", "pritti")["data"]["PRITTI_HOME"] == "/data"


@pytest.mark.parametrize("stage", STAGES)
def test_prod_scales_workers_on_spot_nodes(stage, manifests):
    cluster = find(manifests("prod"), "RayJob", stage)["spec"]["rayClusterSpec"]
    head = cluster["headGroupSpec"]["template"]["spec"]
    assert cluster["enableInTreeAutoscaling"] and cluster["autoscalerOptions"]["version"] == "v2"
    assert head["nodeSelector"] == {"pritti/pool": "regular"} and "tolerations" not in head
    for group in cluster["workerGroupSpecs"]:
        spec = group["template"]["spec"]
        assert spec["nodeSelector"] == {"pritti/pool": f"spot-{group['groupName']}"}
        assert {"pritti/spot", "cloud.google.com/gke-spot"} <= {one["key"] for one in spec["tolerations"]}
        limits = spec["containers"][0]["resources"]["limits"]
        assert ("nvidia.com/gpu" in limits) == (group["groupName"] == "gpu")
    assert {group["groupName"] for group in cluster["workerGroupSpecs"]} - {"gpu"} == {"cpu"}


def test_prod_account_is_mounted_by_autoscaler_only(manifests):
    cluster = find(manifests("prod"), "RayJob", "train-dit")["spec"]["rayClusterSpec"]
    head = cluster["headGroupSpec"]["template"]["spec"]
    (mount,) = cluster["autoscalerOptions"]["volumeMounts"]
    assert mount["mountPath"] == "/var/run/secrets/kubernetes.io/serviceaccount"
    assert mount["name"] in [volume["name"] for volume in head["volumes"]]
    assert mount["name"] not in [one["name"] for one in head["containers"][0].get("volumeMounts", [])]


def test_prod_reads_bucket_with_user_created_secret(manifests):
    documents = manifests("prod")
    assert find(documents, "ConfigMap", "pritti")["data"]["PRITTI_HOME"].startswith("s3://")
    using = [document for document in documents if document["kind"] in ("Deployment", "RayJob")]
    for document in using:
        for path, container in list_containers(document):
            assert {"secretRef": {"name": "bucket"}} in container["envFrom"], path


RAY = "spec.rayClusterSpec"
WORKER = f"{RAY}.workerGroupSpecs.0"
HEAD = f"{RAY}.headGroupSpec.template.spec"
POD, CRON_POD = "spec.template.spec", "spec.jobTemplate.spec.template.spec"
MISSING = object()
PLANTED = {
    "misspelt field of a RayJob": ("RayJob", "train-dit", "spec.backofLimit", 2),
    "misspelt field of a container": ("RayJob", "train-dit", f"{HEAD}.containers.0.workingDirectory", "/pritti"),
    "misspelt field of a Deployment": ("Deployment", "mlflow", f"{POD}.containers.0.readinesProbe", {}),
    "misspelt field of a policy": ("NetworkPolicy", "ray", "spec.podSelecter", {}),
    "misspelt field of metadata": ("RayJob", "train-dit", "metadata.label", {"stage": "train-dit"}),
    "wrong type in a RayJob": ("RayJob", "train-dit", "spec.ttlSecondsAfterFinished", "300"),
    "wrong type in a CronJob": ("CronJob", "nightly-evaluation", "spec.jobTemplate.spec.backoffLimit", "three"),
    "number as a start parameter": ("RayJob", "sample", f"{RAY}.headGroupSpec.rayStartParams.num-cpus", 0),
    "missing head": ("RayJob", "sample", f"{RAY}.headGroupSpec", MISSING),
    "missing name of a group": ("RayJob", "sample", f"{WORKER}.groupName", MISSING),
    "missing schedule": ("CronJob", "nightly-evaluation", "spec.schedule", MISSING),
    "wrong enumeration value": ("RayJob", "evaluate", f"{RAY}.authOptions.mode", "password"),
    "wrong version of the autoscaler": ("RayJob", "evaluate", f"{RAY}.autoscalerOptions.version", "v3"),
    "wrong submission mode": ("RayJob", "evaluate", "spec.submissionMode", "Sidecar"),
    "no token": ("RayJob", "evaluate", f"{RAY}.authOptions.mode", "disabled"),
    "other version of Ray": ("RayJob", "evaluate", f"{RAY}.rayVersion", "2.59.0"),
    "more replicas than the maximum": ("RayJob", "train-lvae", f"{WORKER}.minReplicas", 99),
    "negative replicas": ("RayJob", "train-lvae", f"{WORKER}.minReplicas", -1),
    "missing image": ("Deployment", "studio", f"{POD}.containers.0.image", MISSING),
    "tag latest": ("RayJob", "sample", f"{HEAD}.containers.0.image", "pritti:latest"),
    "image without a tag": ("RayJob", "sample", "spec.submitterPodTemplate.spec.containers.0.image", "pritti"),
    "password in plain text": (
        "Deployment",
        "mlflow",
        f"{POD}.containers.0.env.0",
        {"name": "AWS_SECRET_ACCESS_KEY", "value": "0123456789"},
        f"{POD}.containers.0.env.0.value",
    ),
    "password in a ConfigMap": ("ConfigMap", "pritti", "data.AWS_SECRET_ACCESS_KEY", "0123456789"),
    "missing security context": ("RayJob", "preprocess", f"{HEAD}.containers.0.securityContext", MISSING),
    "privileged container": ("RayJob", "preprocess", f"{HEAD}.containers.0.securityContext.privileged", True),
    "container of root": ("Deployment", "studio", f"{POD}.containers.0.securityContext.runAsUser", 0),
    "port of the host": ("Deployment", "studio", f"{POD}.containers.0.ports.0.hostPort", 8600),
    "network of the host": ("RayJob", "preprocess", f"{HEAD}.hostNetwork", True),
    "account of a head": ("RayJob", "preprocess", f"{HEAD}.automountServiceAccountToken", True),
    "port of the node": ("Service", "studio", "spec.type", "NodePort"),
    "head outside Kubernetes": ("RayJob", "sample", f"{RAY}.headGroupSpec.serviceType", "LoadBalancer"),
    "missing claim": (
        "Deployment",
        "mlflow",
        f"{POD}.volumes.0.persistentVolumeClaim.claimName",
        "mlfow",
    ),
    "missing Secret": ("Deployment", "studio", f"{POD}.volumes.0.secret.secretName", "studio-token"),
    "missing ConfigMap": ("CronJob", "nightly-evaluation", f"{CRON_POD}.volumes.0.configMap.name", "nightly"),
    "missing account": ("CronJob", "nightly-evaluation", f"{CRON_POD}.serviceAccountName", "nightly"),
    "missing volume": ("Deployment", "mlflow", f"{POD}.containers.0.volumeMounts.0.name", "data"),
    "selector without pods": ("Service", "mlflow", "spec.selector", {"app": "mlflow"}),
    "unknown option of a job": ("RayJob", "sample", "spec.entrypoint", "jobs/sample_scenes.py --num-scene 8"),
    "renamed option of a job": ("RayJob", "sample", "spec.entrypoint", "jobs/sample_scenes.py --steps 20"),
    "unknown job": ("RayJob", "sample", "spec.entrypoint", "python jobs/sample.py"),
    "more workers than GPUs": (
        "RayJob",
        "train-dit",
        "spec.entrypoint",
        "jobs/train_dit.py kitti360 --num-workers 16 --gpus 1 --wait-for-resources 900",
    ),
    "lease of a lost head": ("RayJob", "preprocess", "spec.entrypoint", "jobs/preprocess_scenes.py town"),
    "no wait for GPUs": ("RayJob", "train-dit", "spec.entrypoint", "jobs/train_dit.py kitti360 --gpus 1"),
    "fall-back to CPUs": (
        "RayJob",
        "train-dit",
        "spec.entrypoint",
        "jobs/train_dit.py kitti360 --wait-for-resources 9",
    ),
}


def plant(document: dict, path: str, value: object) -> None:
    """Set or delete a field."""
    *parents, last = [int(key) if key.isdecimal() else key for key in path.split(".")]
    target = get(document, *parents)
    if value is MISSING:
        del target[last]
    else:
        target[last] = value


@pytest.mark.parametrize("error", PLANTED)
def test_planted_error_is_reported(error, manifests):
    kind, name, path, value, *reported = PLANTED[error]
    documents = manifests("prod")
    plant(find(documents, kind, name), path, value)
    problems = check_all(documents)
    field = re.escape(reported[0] if reported else path)
    assert [problem for problem in problems if re.match(rf"{kind} {name}: {field}[.:]", problem)]
    assert all(problem.startswith(f"{kind} {name}: ") for problem in problems)


def test_cluster_without_job_needs_token(manifests):
    job = find(manifests("prod"), "RayJob", "sample")
    cluster = {"apiVersion": "ray.io/v1", "kind": "RayCluster", "metadata": {"name": "idle"}}
    cluster["spec"] = job["spec"]["rayClusterSpec"]
    assert [*check_schema(cluster), *check_workload(cluster), *check_cluster(cluster)] == []
    del cluster["spec"]["authOptions"]
    assert list(check_cluster(cluster)) == [(("spec", "authOptions", "mode"), "the cluster has no token")]


def test_missing_renderer_fails_in_ci_only(monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "find_renderer", lambda: None)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="no kubectl"):
        require_renderer()
    monkeypatch.delenv("CI")
    with pytest.raises(pytest.skip.Exception, match="no kubectl"):
        require_renderer()


def test_unknown_kind_is_reported():
    document = {"apiVersion": "ray.io/v1alpha1", "kind": "RayJob", "metadata": {"name": "old"}, "spec": {}}
    assert list(check_schema(document)) == [(("kind",), "no schema of ray.io/v1alpha1/RayJob")]


def load_script():
    spec = importlib.util.spec_from_file_location("start_rayjob", FOLDER / "base/nightly/start_rayjob.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_nightly_copy_is_valid(overlay, manifests):
    copy = load_script().make_copy(find(manifests(overlay), "RayJob", "evaluate"), "evaluate-20260101")
    assert list(check_schema(copy)) == [] and copy["metadata"]["name"] == "evaluate-20260101"
    assert "shutdownAfterJobFinishes" not in copy["spec"] and copy["spec"]["entrypoint"].startswith("jobs/evaluate")


class FakeServer(BaseHTTPRequestHandler):
    """The two requests of the API server that the nightly evaluation needs."""

    jobs: dict

    def log_message(self, *_) -> None:
        pass

    def answer(self, status: int, body: dict) -> None:
        self.send_response(status)
        self.end_headers()
        self.wfile.write(json.dumps(body).encode())

    def do_GET(self) -> None:
        is_known = self.headers["Authorization"] == "Bearer account" and self.path in self.jobs
        self.answer(*((200, self.jobs[self.path]) if is_known else (404, {})))

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        path = f"{self.path}/{body['metadata']['name']}"
        is_new = path not in self.jobs
        self.jobs.setdefault(path, body)
        self.answer(201 if is_new else 409, body)


def test_nightly_script_creates_one_copy_per_day(tmp_path, monkeypatch, capsys):
    rayjob = {"apiVersion": "ray.io/v1", "kind": "RayJob", "metadata": {"name": "evaluate"}, "spec": {}}
    folder = "/apis/ray.io/v1/namespaces/test/rayjobs"
    monkeypatch.setattr(FakeServer, "jobs", {f"{folder}/evaluate": rayjob}, raising=False)
    server = HTTPServer(("127.0.0.1", 0), FakeServer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (tmp_path / "namespace").write_text("test")
    (tmp_path / "token").write_text("account")
    monkeypatch.setenv("ACCOUNT_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("API_SERVER", f"http://127.0.0.1:{server.server_port}")
    script = load_script()
    script.main("evaluate")
    script.main("evaluate")
    with pytest.raises(SystemExit, match="RayJob train does not exist"):
        script.main("train")
    server.shutdown()
    server.server_close()
    created, again = capsys.readouterr().out.splitlines()
    assert created.startswith("created RayJob evaluate-2") and again.endswith("exists already")
    assert len(FakeServer.jobs) == 2


def test_nightly_account_has_least_privilege(manifests):
    rules = find(manifests("prod"), "Role", "nightly-evaluation")["rules"]
    read, create = ({key: rule.get(key) for key in ("resources", "resourceNames", "verbs")} for rule in rules)
    assert read == {"resources": ["rayjobs"], "resourceNames": ["evaluate"], "verbs": ["get"]}
    assert create == {"resources": ["rayjobs"], "resourceNames": None, "verbs": ["create"]}


def test_documented_images_have_project_version(manifests):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert read_documented_images() == {f"pritti:{version}", f"pritti-cuda:{version}"}
    used = {c["image"] for overlay in OVERLAYS for d in manifests(overlay) for _, c in list_containers(d)}
    assert used == read_documented_images()
    assert f"ARG VERSION={version}\n" in (ROOT / "infra/Dockerfile").read_text()


def test_dockerfile_installs_packages_before_sources():
    text = (ROOT / "infra/Dockerfile").read_text()
    packages, sources = text.index("-r requirements.txt"), text.index("COPY models models")
    assert packages < sources < text.index("--no-deps --no-build-isolation -e .")
    assert "HEALTHCHECK" in text and text.index("USER pritti") < text.rindex("CMD")
    for name in ("title", "description", "licenses", "version", "revision", "base.name"):
        assert f"org.opencontainers.image.{name}=" in text


def test_dockerfile_lists_packages_of_pyproject(tmp_path):
    """The command of the Dockerfile prints the build requirements, the dependencies and those of the extra s3."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = content["project"]
    expected = content["build-system"]["requires"] + project["dependencies"] + project["optional-dependencies"]["s3"]
    code = re.search(r'python -c "(import tomllib.*?)" > requirements', (ROOT / "infra/Dockerfile").read_text(), re.S)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    words = [sys.executable, "-c", code[1].replace("\\\n", "")]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:-1] == expected


def test_build_context_contains_copied_files_only():
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if not line.startswith("#")]
    copies = re.findall(r"^COPY (.*) \S+$", (ROOT / "infra/Dockerfile").read_text(), re.M)
    sources = {source for words in copies for source in words.split()}
    assert lines[0] == "*" and {line[1:] for line in lines if line.startswith("!")} == sources
    assert all((ROOT / source).exists() for source in sources) and "**/__pycache__" in lines


def test_readme_documents_requirements():
    text = (FOLDER / "README.md").read_text()
    for kind, name in EXTERNAL - {("ConfigMap", "kube-root-ca.crt")}:
        assert re.search(rf"create secret generic {name}\b", text), (kind, name)
    tag = re.search(r'KUBERAY_TAG, \w+ = "v([\d.]+)"', (DATA / "extract_schemas.py").read_text())[1]
    assert f"KubeRay {tag}" in text and f"v{tag}" in (DATA / "README.md").read_text()
    assert max(map(len, text.splitlines())) <= 120
    assert all(f"`{stage}`" in text for stage in STAGES)
