"""What `memmlp train` says of a network's size."""

from __future__ import annotations

from memmlp.cli.train_summary import size

MEASURED = {"parameters": 19_238, "parameters_with_vqvae": 27_050, "macs": 218_048, "onnx_bytes": 995_047}


def test_a_small_network_has_operations_and_its_vqvae():
    assert size(MEASURED).startswith("0.02 M parameters (0.03 M with the frozen VQ-VAE), 0.218 MMAC a frame")


def test_a_network_without_a_vqvae_has_none():
    assert "VQ-VAE" not in size(MEASURED | {"parameters_with_vqvae": 19_238})
