"""What a server adds to an action chunk: the same request answered locally and through `pi05-geometry serve` on loopback.

    python -m benchmarks.serving --variant tiny --rounds 100 --output serving.json

Two RGB-D cameras of 640 x 480 pixels, a policy with random weights. Local and served requests alternate. Overhead is what the
client waits beyond what the server spends on processors and policy (`infer_ms`), which is what a local run spends too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy, load_policy
from lerobot_policy_pi05_geometry.geometry import CameraCalibration
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from lerobot_policy_pi05_geometry.serving.client import PolicyClient

HEIGHT, WIDTH, JOINTS = 480, 640, 7
CAMERAS = ("front", "wrist")


def write_checkpoint(folder: Path, variant: str) -> None:
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,))}
    for camera in CAMERAS:
        inputs[f"observation.images.{camera}"] = PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH))
        inputs[f"observation.images.{camera}_depth"] = PolicyFeature(FeatureType.VISUAL, (1, HEIGHT, WIDTH))
    calibration = CameraCalibration([600.0, 600.0, 319.5, 239.5], [WIDTH, HEIGHT], torch.eye(4).tolist())
    config = PI05GeometryConfig(
        device="cpu", paligemma_variant=variant, action_expert_variant=variant, push_to_hub=False, input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))},
        calibration=dict.fromkeys(CAMERAS, calibration),
    )  # fmt: skip
    policy = PI05GeometryPolicy(config)
    stats = {key: {"q01": -torch.ones(JOINTS), "q99": torch.ones(JOINTS)} for key in ("observation.state", "action")}
    for part in (policy, *make_pi05_geometry_pre_post_processors(config, stats)):
        part.save_pretrained(folder)


def make_request(random: np.random.Generator) -> dict[str, Any]:
    request: dict[str, Any] = {"state": random.uniform(-1, 1, JOINTS).astype(np.float32), "prompt": "push the button"}
    request["images"] = {name: random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for name in CAMERAS}
    request["depth"] = {name: random.integers(300, 1800, (HEIGHT, WIDTH), np.uint16) for name in CAMERAS}
    return request


@torch.no_grad()
def local(loaded: LoadedPolicy, request: dict[str, Any]) -> None:
    """As lerobot-rollout does it: images to float, then processors and policy."""
    batch: dict[str, Any] = {"observation.state": torch.from_numpy(request["state"])[None], "task": [request["prompt"]]}
    for name in CAMERAS:
        image = torch.from_numpy(request["images"][name]).float() / 255
        batch[f"observation.images.{name}"] = image.permute(2, 0, 1).contiguous()[None]
        batch[f"observation.images.{name}_depth"] = torch.from_numpy(request["depth"][name])[None, None]
    loaded.postprocess(loaded.policy.predict_action_chunk(loaded.preprocess(batch)))


def quantiles(values: list[float]) -> dict[str, float]:
    return {"p50": float(np.percentile(values, 50)), "p95": float(np.percentile(values, 95))}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--variant", default="tiny", choices=("tiny", "small"))
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    random, times = np.random.default_rng(0), {"local": [], "served": [], "infer": [], "overhead": []}
    with tempfile.TemporaryDirectory() as folder:
        write_checkpoint(Path(folder) / "checkpoint", given.variant)
        loaded = load_policy(Path(folder) / "checkpoint")
        command = ["-m", "pi05_geometry_cli", "serve", f"{folder}/checkpoint", "--port", "0"]
        server = subprocess.Popen(
            [sys.executable, *command], stdout=subprocess.PIPE, text=True, env=os.environ | {"COLUMNS": "200"}
        )
        assert server.stdout is not None
        try:
            line = next(line for line in server.stdout if line.startswith("Serving"))
            client = PolicyClient(line.split()[-1], timeout=120)
            for i in range(given.rounds + 5):
                request = make_request(random)
                begin = time.perf_counter()
                local(loaded, request)
                middle = time.perf_counter()
                answer = client.infer(request)
                end = time.perf_counter()
                if i >= 5:
                    times["local"].append(1e3 * (middle - begin))
                    times["served"].append(1e3 * (end - middle))
                    times["infer"].append(answer["server_timing"]["infer_ms"])
                    times["overhead"].append(1e3 * (end - middle) - answer["server_timing"]["infer_ms"])
            client.close()
        finally:
            server.terminate()
            server.wait()
    result = {"variant": given.variant, "rounds": given.rounds, "ms": {k: quantiles(v) for k, v in times.items()}}
    print(json.dumps(result, indent=2))
    if given.output is not None:
        given.output.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
