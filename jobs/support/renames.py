"""Earlier names of options and option values.

Using an earlier name is an error. The error message contains the current name.
"""

from __future__ import annotations

from collections.abc import Sequence

# Options that were renamed in every job: earlier name -> current name.
OPTIONS = {
    "accumulate": "gradient-accumulation-steps",
    "actors": "num-actors",
    "guidance": "guidance-scale",
    "known-guidance": "pseudoinverse-guidance",
    "limit": "max-scenes",
    "resamplings": "num-resamplings",
    "workers": "num-workers",
}

# Options that were renamed in one job.
JOB_OPTIONS = {
    "ablate_lvae": {
        "any-sizes": "any-footprint-train-sizes",
        "checks": "num-checkpoints",
        "moving-sizes": "yaw-only-train-sizes",
        "noisy": "num-noisy-boxes",
        "only": "only-variants",
        "parallel": "max-concurrent-trials",
        "seeds": "num-seeds",
        "sizes": "train-sizes",
        "test": "num-test-boxes",
    },
    "edit_scenes": {
        "about-m": "pivot-m",
        "along": "frame",
        "by": "factors",
        "by-deg": "angle-deg",
        "by-m": "offset-m",
        "hold": "anchor",
        "label": "class-name",
        "pictures": "num-examples",
        "push-m": "max-push-m",
        "shrink": "min-shrink",
    },
    "evaluate_scenes": {
        "apart-m": "min-distance-m",
        "balance": "balance-labels",
        "limit": "max-reconstructed-scenes",
        "no-balance": "no-balance-labels",
        "pictures": "num-examples",
        "samples": "max-scenes",
    },
    "evaluate_voxels": {
        "partial": "allow-missing",
        "rebuilt": "reconstructed",
        "stored": "compressed",
        "truth": "ground-truth",
        "truth-axes": "ground-truth-axes",
    },
    "inpaint_scenes": {
        "objects": "primitives",
        "outside": "invert-region",
        "pictures": "num-examples",
        "steps": "num-inference-steps",
        "variants": "num-variants",
    },
    "inspect_scenes": {
        "columns": "num-columns",
        "count": "max-scenes",
        "pictures": "num-examples",
        "size": "size-px",
    },
    "outpaint_scenes": {
        "ahead": "blocks-ahead",
        "behind": "blocks-behind",
        "left": "blocks-left",
        "mode": "neighbour-latents",
        "right": "blocks-right",
        "steps": "num-inference-steps",
    },
    "paint_streets": {"control": "controlnet-conditioning-scale", "steps": "num-inference-steps"},
    "preprocess_scenes": {"no-split": "no-make-split", "split": "make-split"},
    "render_streets": {
        "frames": "max-frames",
        "height": "height-px",
        "right": "lateral-offset",
        "width": "width-px",
    },
    "run_demo": {
        "num-released": "num-released-scenes",
        "outpaint-steps": "outpaint-inference-steps",
        "sampling-steps": "num-inference-steps",
    },
    "sample_scenes": {"glb": "num-glb", "steps": "num-inference-steps"},
    "serve_studio": {"names": "host-names", "tables": "datasets", "threads": "num-threads", "token": "token-file"},
    "sweep_references": {"apart-m": "min-distances-m", "sizes": "reference-sizes"},
    "sweep_samplers": {"pictures": "num-examples", "steps": "num-inference-steps"},
    "sweep_seams": {"mode": "neighbour-latents"},
    "train_dit": {"label": "label-kind", "prediction": "prediction-type", "timesteps": "timestep-sampling"},
    "train_lvae": {"keep-latents-of": "train-object-decoder-of"},
}

# (job, current option) -> earlier values and current values.
VALUES = {
    ("edit_scenes", "frame"): {"own": "object"},
    ("evaluate_scenes", "reference"): {"farthest": "farthest-point", "apart": "min-distance", "spread": "uniform"},
    ("inspect_scenes", "pick"): {"spread": "uniform"},
    ("train_dit", "prediction-type"): {"noise": "epsilon", "velocity": "v_prediction"},
    ("train_dit", "timestep-sampling"): {"even": "uniform", "middle": "logit-normal"},
}


def find_renamed(job: str, words: Sequence[str]) -> str | None:
    """Return a message about the first outdated option name or value on a command line, or None.

    Args:
        job: Module name, such as "sample_scenes".
        words: Words of the command line.
    """
    options = OPTIONS | JOB_OPTIONS.get(job, {})
    for k, word in enumerate(words):
        if not word.startswith("--"):
            continue
        name, equals, value = word[2:].partition("=")
        name = name.replace("_", "-")
        if name in options:
            return f"--{name} was renamed to --{options[name]}"
        if not equals:
            value = words[k + 1] if k + 1 < len(words) else ""
        if present := VALUES.get((job, name), {}).get(value):
            return f"--{name} {value} was renamed to --{name} {present}"
    return None
