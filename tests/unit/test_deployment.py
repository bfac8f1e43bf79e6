"""Tests of SECURITY.md and of the manifests in infra/."""

import re
from pathlib import Path

import yaml

from models.limits import LIMITS

ROOT = Path(__file__).parents[2]


def load_manifest() -> tuple[dict, dict]:
    job, policy = yaml.safe_load_all((ROOT / "infra/rayjob.yaml").read_text())
    return job, policy


def list_templates(job: dict) -> list[dict]:
    cluster = job["spec"]["rayClusterSpec"]
    workers = [group["template"] for group in cluster["workerGroupSpecs"]]
    return [cluster["headGroupSpec"]["template"], *workers, job["spec"]["submitterPodTemplate"]]


def test_rayjob_requires_token_and_opens_no_port():
    job, policy = load_manifest()
    cluster = job["spec"]["rayClusterSpec"]
    assert cluster["authOptions"] == {"mode": "token"} and cluster["headGroupSpec"]["serviceType"] == "ClusterIP"
    selected = policy["spec"]["podSelector"]["matchLabels"]
    for template in list_templates(job):
        assert selected.items() <= template["metadata"]["labels"].items()
        assert template["spec"]["automountServiceAccountToken"] is False
        for container in template["spec"]["containers"]:
            assert not container.get("ports") and container["securityContext"]["runAsNonRoot"]
    assert policy["kind"] == "NetworkPolicy" and policy["spec"]["policyTypes"] == ["Ingress"]
    own, operator = policy["spec"]["ingress"]
    assert own == {"from": [{"podSelector": {"matchLabels": selected}}]}
    assert [port["port"] for port in operator["ports"]] == [8265] and "podSelector" in operator["from"][0]


def test_security_page_lists_limits():
    text = (ROOT / "SECURITY.md").read_text()
    listed = {
        name.lower(): (value, meaning)
        for name, value, meaning in re.findall(r"\| ([A-Z_]+) \| ([\d,]+) \| (.*) \|", text)
    }
    assert listed == {name: (f"{limit.value:,}", limit.meaning) for name, limit in LIMITS.items()}
