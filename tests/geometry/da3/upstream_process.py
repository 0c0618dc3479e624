"""Runs the upstream package in a process of its own, so that it never meets the project's environment.

    python upstream_process.py PACKAGES keys OUTPUT.json
    python upstream_process.py PACKAGES features CASES.json OUTPUT_FOLDER

PACKAGES: folder with `depth-anything-3` and what it needs beyond the environment. CASES: {"net": registry name or settings
of its transformer, "out_layers": [...], "images": [[batch, views, height, width], ...]}.
"""

import json
import sys
from pathlib import Path

import torch
from accelerate import init_empty_weights
from safetensors.torch import save_file

PARTS = {"net": "backbone", "head": "head", "cam_enc": "cam_enc", "cam_dec": "cam_dec", "gs_head": "gs_head"}


def released_keys() -> dict[str, dict[str, list[int]]]:
    """Names, as in released files, and shapes of every model but the nested one, whose parts these are.

    Gaussian splatting's adapter (`model.gs_adapter.`) is left out: it needs further packages.
    """
    from depth_anything_3.cfg import create_object, load_config
    from depth_anything_3.registry import MODEL_REGISTRY

    found = {}
    for name, path in MODEL_REGISTRY.items():
        config = load_config(path)
        if "nested" in name:
            continue
        found[name] = {}
        for part in set(PARTS) & set(config):
            with init_empty_weights():
                module = create_object(config[part])
            for key, tensor in module.state_dict().items():
                found[name][f"model.{PARTS[part]}.{key}"] = list(tensor.shape)
    return found


def transformer(net: str | dict) -> torch.nn.Module:
    from depth_anything_3.cfg import create_object, load_config
    from depth_anything_3.model.dinov2.vision_transformer import DinoVisionTransformer
    from depth_anything_3.registry import MODEL_REGISTRY

    if isinstance(net, dict):
        return DinoVisionTransformer(img_size=518, patch_size=14, **net)
    return create_object(load_config(MODEL_REGISTRY[net])["net"]).pretrained


@torch.no_grad()
def redraw(module: torch.nn.Module) -> None:
    """Random weights that keep signals of order one: a fresh network's zeros and ones hide errors."""
    for name, parameter in module.named_parameters():
        if name.endswith(("_token", "pos_embed")):
            parameter.normal_()
        elif parameter.ndim > 1:
            parameter.normal_(std=parameter[0].numel() ** -0.5)
        elif "norm" in name and name.endswith("weight"):
            parameter.normal_(1.0, 0.2)
        else:  # biases and layer scales
            parameter.normal_(0.0, 0.3)


@torch.no_grad()
def features(case: dict, output: Path) -> None:
    """Writes the weights under released names, and per case the images and the features of every layer."""
    torch.manual_seed(0)
    net = transformer(case["net"]).eval()
    redraw(net)
    save_file({f"model.backbone.pretrained.{k}": v for k, v in net.state_dict().items()}, output / "model.safetensors")
    tensors = {}
    for i, (batch, views, height, width) in enumerate(case["images"]):
        images = torch.randn(batch, views, 3, height, width)
        tensors[f"{i}.images"] = images
        outputs, _ = net.get_intermediate_layers(images, case["out_layers"], ref_view_strategy="first")
        for layer, (found, _) in zip(case["out_layers"], outputs, strict=True):
            tensors[f"{i}.{layer}"] = found.contiguous()
    save_file(tensors, output / "features.safetensors")


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.path.append(sys.argv[1])
    if sys.argv[2] == "keys":
        Path(sys.argv[3]).write_text(json.dumps(released_keys()))
    else:
        features(json.loads(Path(sys.argv[3]).read_text()), Path(sys.argv[4]))
