"""lerobot-eval through a server: the same episodes as a local run, to the last bit of the reward."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.envs.utils import env_to_policy_features
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.random_utils import set_seed

from lerobot_policy_pi05_geometry import MetaworldRgbdEnv
from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.geometry import CameraCalibration
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.entry_points import make_policy

from .running import real_server, serving

pytestmark = [pytest.mark.long, pytest.mark.sim]

SIZE, STEPS, EPISODES, SEED = 28, 40, 3, 5
OUTCOMES = ("sum_rewards", "max_rewards", "successes")


def write_checkpoint(folder: Path) -> Path:
    """A policy with random weights for the simulated robot; its actions fill the action space."""
    features = env_to_policy_features(MetaworldRgbdEnv(image_size=SIZE))
    policy = make_policy(
        input_features={key: feature for key, feature in features.items() if key != "action"},
        output_features={"action": features["action"]},
        calibration={"front": CameraCalibration([SIZE, SIZE, (SIZE - 1) / 2, (SIZE - 1) / 2], [SIZE, SIZE])},
        chunk_size=10,
        n_action_steps=5,
    )
    stats = {
        "observation.state": {"q01": -torch.ones(4), "q99": torch.ones(4)},
        "action": {"q01": -0.3 * torch.ones(4), "q99": 0.3 * torch.ones(4)},
    }
    for part in (policy, *make_pi05_geometry_pre_post_processors(policy.config, stats)):
        part.save_pretrained(folder)
    return folder


def evaluate(output: Path, *policy: str) -> dict:
    """Outcome of every episode."""
    result = subprocess.run(
        [
            sys.executable, "-m", "lerobot.scripts.lerobot_eval", *policy, "--policy.device=cpu",
            "--env.type=metaworld_rgbd", f"--env.image_size={SIZE}", f"--env.episode_length={STEPS}",
            f"--eval.n_episodes={EPISODES}", "--eval.batch_size=1", "--eval.use_async_envs=false", f"--seed={SEED}",
            f"--output_dir={output}",
        ],
        env=os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl"},
        capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr[-4000:]
    info = json.loads((output / "eval_info.json").read_text())
    return info["per_task"][0]["metrics"]


def evaluate_locally(checkpoint: Path) -> dict:
    """The same by LeRobot's own loop around the local policy. Its noise is torch's: what is drawn after the seed."""
    loaded = load_policy(checkpoint)
    environment = MetaworldRgbdEnv(image_size=SIZE, episode_length=STEPS)
    vector = environment.create_envs(1)["metaworld_rgbd"][0]
    before, after = environment.get_env_processors()
    set_seed(SEED)
    try:
        found = eval_policy(
            vector, loaded.policy, before, after, loaded.preprocess, loaded.postprocess, EPISODES, start_seed=SEED
        )
    finally:
        vector.close()
    return {
        name: [episode[name.removesuffix("es" if name == "successes" else "s")] for episode in found["per_episode"]]
        for name in OUTCOMES
    }


def test_lerobot_eval_through_a_server_is_the_local_run(tmp_path):
    """lerobot-eval as it is, as a process."""
    checkpoint = write_checkpoint(tmp_path / "checkpoint")
    local = evaluate_locally(checkpoint)
    with serving(real_server(load_policy(checkpoint), (1,))) as running:
        remote = ["--policy.type=pi05_geometry_remote", f"--policy.server={running.url}", "--policy.noise=client"]
        served = evaluate(tmp_path / "served", *remote)
    print(local)  # noqa: T201
    assert len(set(local["sum_rewards"])) == EPISODES
    assert all(math.isfinite(reward) for reward in local["sum_rewards"])
    assert {name: served[name] for name in OUTCOMES} == local
