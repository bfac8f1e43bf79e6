"""Writes torch_fidelity.safetensors: the results of torch-fidelity for the inputs of golden_recipe.py.

These are features of 4 images from its Inception extractor with random weights, and its FID, Inception score, KID,
precision and recall of given features. Run it in a separate environment from the root of the repository. The packages
are CUDA builds, which also run on a CPU, because torchvision does not import with a CPU build of torch:

    python3 -m venv /tmp/fidelity
    /tmp/fidelity/bin/pip install torch===2.13.0 torchvision==0.28.0 torch-fidelity==0.4.0 safetensors
    PYTHONPATH=. /tmp/fidelity/bin/python tests/golden/make_inception_golden.py
"""

import json
import platform
import tempfile

import golden_recipe as recipe
import numpy as np
import safetensors.numpy
import torch
import torch_fidelity
import torchvision
from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3
from torch_fidelity.metric_fid import fid_features_to_statistics, fid_statistics_to_metric
from torch_fidelity.metric_isc import isc_features_to_metric
from torch_fidelity.metric_kid import kid_features_to_metric
from torch_fidelity.metric_prc import prc_features_to_metric

from pipelines.metrics.inception import Inception

LAYERS = ["64", "192", "768", "2048", "logits_unbiased"]


def features(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Per layer (4, d) float32; `spatial` is the output of the branch that ADM's sFID takes, channels last."""
    with tempfile.NamedTemporaryFile(suffix=".pth") as file:
        torch.save({name: torch.from_numpy(value) for name, value in state.items()}, file.name)
        extractor = FeatureExtractorInceptionV3("random", LAYERS, feature_extractor_weights_path=file.name)
    maps = []
    extractor.Mixed_6d.branch1x1.register_forward_hook(lambda module, inputs, output: maps.append(output))
    rows = []
    for k in range(len(recipe.PICTURES)):
        x = torch.from_numpy(recipe.picture(k)).permute(2, 0, 1)[None]
        rows.append(dict(zip(LAYERS, extractor(x), strict=True)))
        rows[-1]["spatial"] = maps[k].permute(0, 2, 3, 1)[..., :7].reshape(1, -1)
    return {name: torch.cat([row[name] for row in rows]).numpy() for name in rows[0]}


def scores() -> dict[str, float]:
    """torch-fidelity's numbers of the given features; real features are its second argument."""
    real, generated = map(torch.from_numpy, recipe.feature_sets())
    logits = torch.from_numpy(recipe.logits())
    few = generated[:20]

    def fid(x, y):
        return fid_statistics_to_metric(fid_features_to_statistics(x), fid_features_to_statistics(y), False)

    found = {
        "fid": fid(generated, real),
        "fid_few": fid(few, real),
        "isc_1": isc_features_to_metric(logits, splits=1),
        "isc_10": isc_features_to_metric(logits, splits=10),
        "kid_all": kid_features_to_metric(generated, real, kid_subsets=1, kid_subset_size=300, verbose=False),
        "kid_subsets": kid_features_to_metric(generated, real, kid_subsets=10, kid_subset_size=100, verbose=False),
    }
    for k in (1, 3, 5):
        found[f"prc_{k}"] = prc_features_to_metric(generated, real, prc_neighborhood=k, verbose=False)
        found[f"prc_{k}_few"] = prc_features_to_metric(few, real, prc_neighborhood=k, verbose=False)
    return {f"{name}.{key}": value for name, metrics in found.items() for key, value in metrics.items()}


def main() -> None:
    torch.set_num_threads(1)  # the same sums in the same order
    state = recipe.random_state_dict({name: value.shape for name, value in Inception().state_dict().items()})
    versions = {module.__name__: module.__version__ for module in (torch_fidelity, torch, torchvision, np)}
    metadata = {
        "recipe_sha256": recipe.recipe_sha256(state),
        "versions": json.dumps(versions | {"python": platform.python_version(), "machine": platform.machine()}),
        "scores": json.dumps(scores()),
    }
    safetensors.numpy.save_file(features(state), recipe.GOLDEN, metadata)
    print(f"{recipe.GOLDEN}: {recipe.GOLDEN.stat().st_size} bytes", *metadata.items(), sep="\n")


if __name__ == "__main__":
    main()
