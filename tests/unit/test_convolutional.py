"""Tests that compare the convolutional networks of the ground branch with diffusers."""

import pytest
import torch
from diffusers.models.autoencoders.vae import Decoder, Encoder

from models.vae.convolutional import ConvolutionalDecoder, ConvolutionalEncoder

CASES = [((8, 16, 16), True), ((32, 64), False), ((32,), False), ((16, 32, 32, 64), True)]


@pytest.mark.parametrize(("channels", "attention"), CASES)
@pytest.mark.parametrize("training", [True, False])
def test_networks_equal_diffusers_bit_for_bit(channels, attention, training):
    options = {
        "block_out_channels": channels,
        "layers_per_block": 1,
        "mid_block_add_attention": attention,
        "norm_num_groups": 4,
    }
    pairs = [
        (
            lambda: Encoder(10, 6, ("DownEncoderBlock2D",) * len(channels), double_z=True, **options),
            lambda: ConvolutionalEncoder(10, 12, channels, 4, attention),
            (2, 10, 32, 32),
        ),
        (
            lambda: Decoder(6, 10, ("UpDecoderBlock2D",) * len(channels), **options),
            lambda: ConvolutionalDecoder(6, 10, channels, 4, attention),
            (2, 6, 8, 8),
        ),
    ]
    for reference, own, shape in pairs:
        torch.manual_seed(0)
        theirs = reference().train(training)
        torch.manual_seed(0)
        ours = own().train(training)
        parameters, expected = dict(ours.named_parameters()), dict(theirs.named_parameters())
        assert list(parameters) == list(expected)
        assert all(torch.equal(parameters[name], expected[name]) for name in expected)
        x = torch.randn(shape)
        assert torch.equal(ours(x), theirs(x))
        ours(x).square().sum().backward()
        theirs(x).square().sum().backward()
        assert all(torch.equal(parameters[name].grad, expected[name].grad) for name in expected)
