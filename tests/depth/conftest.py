"""A network for monocular depth."""

import pytest
import torch
from needs import needs


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    """A folder with random weights of a network a thousand times smaller than the published ones."""
    transformers = needs("transformers", "depth-anything-v2")
    stages = {"out_features": ["stage1", "stage2", "stage3", "stage4"], "reshape_hidden_states": False}
    backbone = transformers.Dinov2Config(
        hidden_size=8, num_hidden_layers=4, num_attention_heads=2, image_size=28, patch_size=14, **stages
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=8, neck_hidden_sizes=[4] * 4, fusion_hidden_size=4,
        head_hidden_size=4, patch_size=14,
    )  # fmt: skip
    torch.manual_seed(1)
    folder = tmp_path_factory.mktemp("weights")
    network = transformers.DepthAnythingForDepthEstimation(config)
    for parameter in network.parameters():
        parameter.data.normal_(0, 0.3)
    network.head.conv3.bias.data.fill_(5)  # so that not everything is infinitely far
    network.save_pretrained(folder)
    return folder
