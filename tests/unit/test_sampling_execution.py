"""Tests of how sampling runs: noise that is drawn ahead, fixed shapes, bfloat16, compiled blocks and decoding."""

import numpy as np
import pytest
import torch
from helpers import ROOT, run_command, small_spec, tiny_pipeline

import models.execution
from models.execution import FixedShapeDenoiser, SamplingExecution, require_bf16
from models.sampling.diffusion import InpaintCondition, SceneNoise, finish_drawing, make_keyed_generator, start_drawing
from models.sampling.repaint import RePaintConfig
from models.training import sample_noise

LABELS = ["low", "medium", "high"]


def make_pipeline():
    return tiny_pipeline(small_spec())


def record_graph(model, *inputs):
    """Capture like a CUDA graph: the inputs and the output are always in the same memory."""
    static, output = [x.clone() for x in inputs], model(*inputs).clone()

    def replay(*values):
        for place, value in zip(static, values, strict=True):
            place.copy_(value)
        output.copy_(model(*static))
        return output.clone()

    return replay


def test_noise_drawn_ahead_is_the_same_noise():
    plain, ahead = (SceneNoise(3, range(5), (4, 8, 8), "cpu", ahead=flag) for flag in (False, True))
    assert all(torch.equal(plain.draw(), ahead.draw()) for _ in range(4))


def test_training_noise_of_threads_is_the_same_noise():
    def make_generators():
        return [make_keyed_generator(0, k) for k in range(5)]

    device = torch.device("cpu")
    expected = sample_noise(make_generators(), (4, 8, 8), device, count=2)
    assert expected.shape == (2, 5, 4, 8, 8) and not torch.equal(*expected)
    assert torch.equal(finish_drawing(*start_drawing(make_generators(), (4, 8, 8), device, 2), device), expected)
    one_by_one = make_generators()
    assert torch.equal(torch.cat([sample_noise(one_by_one, (4, 8, 8), device) for _ in range(2)]), expected)


def test_replayed_denoiser_gives_equal_latents(monkeypatch):
    pipeline, captured = make_pipeline(), []

    def capture(model, *inputs):
        captured.append(inputs[0].shape)
        return record_graph(model, *inputs)

    expected = {scale: pipeline.sample_latents(LABELS, 1, range(3), 10, scale) for scale in (1.0, 2.0)}
    denoiser = pipeline.make_denoiser

    def wrapped(*arguments):
        return FixedShapeDenoiser(denoiser(*arguments), capture)

    monkeypatch.setattr(pipeline, "make_denoiser", wrapped)
    for scale, latents in expected.items():
        assert torch.equal(pipeline.sample_latents(LABELS, 1, range(3), 10, scale), latents)
    assert captured == [(3, *pipeline.latent_shape)] * 2  # once per sampling, not once per step


def test_batches_share_a_denoiser_until_something_changes():
    """Batches of a run share one CUDA graph; other labels, timesteps, options or weights need another one."""
    pipeline = make_pipeline()
    times, label = np.array([900, 500, 0]), torch.tensor([0, 1, 1])
    first = pipeline.make_denoiser(times, label)
    assert pipeline.make_denoiser(times, label.flip(0)) is first
    assert pipeline.make_denoiser(times, label, 2.0) is not pipeline.make_denoiser(times, label)
    only, both = pipeline.make_denoiser(times, label), pipeline.make_denoiser(times, torch.tensor([2]))
    assert only is not both and pipeline.make_denoiser(times, label) is both  # The second one knows all three labels.
    assert pipeline.make_denoiser(times, label) is not pipeline.make_denoiser(times[1:], label)
    inputs = torch.randn(3, *pipeline.latent_shape), torch.tensor([500] * 3), label
    before = pipeline.make_denoiser(times, label)(*inputs)
    with torch.no_grad():
        pipeline.dit.patch_out.bias.add_(1)
    after = pipeline.make_denoiser(times, label)(*inputs)
    assert not torch.allclose(after, before, atol=0.1) and torch.equal(after, pipeline.dit(*inputs))
    last = pipeline.make_denoiser(times, label)
    pipeline.set_execution(SamplingExecution(decode_batch_size=2))
    assert pipeline.make_denoiser(times, label) is not last


def test_batches_of_a_run_capture_one_graph(monkeypatch):
    captured = []

    def capture(model, *inputs):
        captured.append(inputs[0].shape)
        return record_graph(model, *inputs)

    monkeypatch.setattr(SamplingExecution, "wrap", lambda execution, model, device: FixedShapeDenoiser(model, capture))
    pipeline = make_pipeline()
    parts = [pipeline.sample_latents(LABELS, 1, range(k, k + 3), 10) for k in (0, 3)]
    assert captured == [(3, *pipeline.latent_shape)]
    monkeypatch.undo()
    assert torch.equal(torch.cat(parts), make_pipeline().sample_latents(2 * LABELS, 1, range(6), 10))


def test_pipeline_samples_in_inference_mode():
    expected = make_pipeline().sample_latents(LABELS, 1, range(3), 4)
    with torch.inference_mode():
        assert torch.equal(make_pipeline().sample_latents(LABELS, 1, range(3), 4), expected)


def test_each_shape_is_captured_once_and_results_are_kept():
    captured = []

    def capture(model, *inputs):
        captured.append(tuple(inputs[0].shape))
        return record_graph(model, *inputs)

    denoise = FixedShapeDenoiser(lambda latent, timestep, label: latent + timestep[:, None], capture)
    first = denoise(torch.zeros(2, 3), torch.tensor([1, 2]), torch.zeros(2))
    second = denoise(torch.zeros(2, 3), torch.tensor([5, 6]), torch.zeros(2))
    third = denoise(torch.zeros(1, 3), torch.tensor([7]), torch.zeros(1))
    assert captured == [(2, 3), (1, 3)]
    assert [x[:, 0].tolist() for x in (first, second, third)] == [[1, 2], [5, 6], [7]]


def test_failed_capture_warns_once_and_gradients_run_plainly():
    def fail(model, *inputs):
        raise RuntimeError("operation not permitted when stream is capturing")

    denoise = FixedShapeDenoiser(lambda latent, timestep, label: 2 * latent, fail)
    inputs = torch.ones(1, 2), torch.zeros(1), torch.zeros(1)
    with pytest.warns(UserWarning, match="no CUDA graph .*not permitted"):
        assert denoise(*inputs).tolist() == [[2, 2]]
    assert denoise(*inputs).tolist() == [[2, 2]]  # A second warning would be an error.
    leaf = torch.ones(1, 2, requires_grad=True)
    replayed = FixedShapeDenoiser(lambda latent, timestep, label: 2 * latent, record_graph)
    replayed(leaf, *inputs[1:]).sum().backward()
    assert leaf.grad is not None and leaf.grad.tolist() == [[2, 2]]


def test_bf16_keeps_float32_where_it_matters():
    """The latents change by rounding only; all weights outside the blocks and the latents stay in float32."""
    pipeline = make_pipeline()
    exact = pipeline.sample_latents(LABELS, 1, range(3), 10)
    pipeline.set_execution(SamplingExecution(precision="bf16"))
    rounded = pipeline.sample_latents(LABELS, 1, range(3), 10)
    types = {name: p.dtype for name, p in pipeline.dit.named_parameters()}
    assert {d for name, d in types.items() if name.startswith("blocks.")} == {torch.bfloat16}
    assert {d for name, d in types.items() if not name.startswith("blocks.")} == {torch.float32}
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, exact)
    assert (rounded - exact).std() < 0.01 * exact.std()


@pytest.mark.parametrize("guidance", [0.0, 1.0], ids=["repaint", "pseudoinverse"])
def test_inpainting_runs_with_the_options_of_sampling(guidance):
    """RePaint in bfloat16 changes by rounding, and the known half stays bit-identical."""
    pipeline = make_pipeline()
    repaint = RePaintConfig(10, 2, 2, guidance)
    known = torch.randn(1, *pipeline.latent_shape, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros_like(known)
    mask[..., : known.shape[-1] // 2] = 1
    condition = InpaintCondition(known, mask)
    exact = pipeline.inpaint_latents(condition, ["low"], 1, [0], repaint)
    pipeline.set_execution(SamplingExecution(precision="bf16", cuda_graphs=True))
    rounded = pipeline.inpaint_latents(condition, ["low"], 1, [0], repaint)
    assert torch.equal(rounded[mask == 0], known[mask == 0]) and not torch.equal(rounded, exact)
    assert (rounded - exact).std() < 0.02 * exact.std()


COMPILE = """
import torch
from torch._dynamo.utils import counters
from helpers import small_spec, tiny_pipeline
from models.dit import DiT
from models.pipeline import PrITTIPipeline
from models.execution import SamplingExecution
lvae = tiny_pipeline(small_spec()).lvae
channels, size, _ = lvae.latent_shape
dit = DiT(channels=channels, size=size, width=32, depth=3, heads=2)
for parameter in dit.parameters():
    torch.nn.init.normal_(parameter, std=0.05)
pipeline = PrITTIPipeline(lvae, dit)
exact = pipeline.sample_latents(["low"], 1, [0], 10)
pipeline.set_execution(SamplingExecution(compile=True))
compiled = pipeline.sample_latents(["low"], 1, [0], 10)
print(torch.allclose(compiled, exact, atol=1e-4), counters["stats"]["unique_graphs"])
"""


@pytest.mark.slow
def test_compiled_blocks_share_one_compilation():
    """Runs in a process without checks of annotations, which cannot be compiled."""
    done = run_command("-c", COMPILE, PYTHONPATH=f"{ROOT}:{ROOT / 'tests'}")
    assert done.stdout.split() == ["True", "1"], done.stderr[-3000:]


@pytest.mark.parametrize("size", [2, 8])
def test_scenes_decoded_together_equal_single_scenes(size):
    """States the tolerance: 1 mm for centres, sizes and heights."""
    pipeline = make_pipeline()
    single = pipeline.generate(LABELS, seed=1, num_inference_steps=10, existence_threshold=0.01)
    pipeline.set_execution(SamplingExecution(decode_batch_size=size))
    together = pipeline.generate(LABELS, seed=1, num_inference_steps=10, existence_threshold=0.01)
    for a, b in zip(single, together, strict=True):
        assert len(a) and np.array_equal(a.category, b.category) and np.array_equal(a.occupied, b.occupied)
        for name in ("center_m", "size_m", "height_m"):
            assert np.allclose(getattr(a, name), getattr(b, name), atol=1e-3)


def test_invalid_execution_and_old_gpus_are_errors(monkeypatch):
    with pytest.raises(ValueError, match="precision is 'fp16', decode_batch_size 1; expected fp32 or bf16"):
        SamplingExecution(precision="fp16")
    with pytest.raises(ValueError, match="decode_batch_size 0"):
        SamplingExecution(decode_batch_size=0)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: False)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Tesla V100")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (7, 0))
    with pytest.raises(ValueError, match=r"Tesla V100 \(compute capability 7.0\) has no bfloat16, .* --precision fp32"):
        require_bf16(torch.device("cuda"))


def test_graphs_are_used_on_gpus_only():
    execution = SamplingExecution(cuda_graphs=True)

    def model(latent, timestep, label):
        return latent

    assert execution.wrap(model, torch.device("cpu")) is model
    wrapped = execution.wrap(model, torch.device("cuda"))
    assert isinstance(wrapped, FixedShapeDenoiser)
    assert wrapped.capture is models.execution.capture_cuda_graph
