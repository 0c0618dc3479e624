"""lerobot-eval through a server: the same episodes as a local run, to the last bit of the reward."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.random_utils import set_seed

from lerobot_policy_pi05_geometry import MetaworldRgbdEnv
from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.sim.record import record

from .running import real_server, serving

pytestmark = [pytest.mark.long, pytest.mark.sim]

TASK, CAMERAS, SIZE = "coffee-button-wide", "fixed", 28
DEMONSTRATIONS, TRAINING_STEPS = 10, 500
EPISODES, SEED = 20, 0
OUTCOMES = ("sum_rewards", "max_rewards", "successes")
PROCESS = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl"}


def train(folder: Path) -> Path:
    """A policy of the tiny size that sometimes succeeds: half a minute of training on ten demonstrations, camera fixed."""
    for _ in record(folder / "demonstrations", "local/demonstrations", TASK, DEMONSTRATIONS, CAMERAS, SIZE):
        pass
    run(
        "lerobot.scripts.lerobot_train", "--policy.type=pi05_geometry", "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny", f"--policy.image_resolution=[{SIZE}, {SIZE}]", "--policy.geometry_grid=3",
        "--policy.chunk_size=10", "--policy.n_action_steps=5", "--policy.max_action_dim=4", "--policy.num_inference_steps=5",
        "--policy.optimizer_lr=1e-3", "--policy.scheduler_decay_lr=5e-5", "--policy.scheduler_warmup_steps=50",
        f"--policy.scheduler_decay_steps={TRAINING_STEPS}", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--batch_size=16", f"--steps={TRAINING_STEPS}", f"--save_freq={TRAINING_STEPS}", "--num_workers=0", "--seed=0",
        "--dataset.repo_id=local/demonstrations", f"--dataset.root={folder / 'demonstrations'}",
        f"--output_dir={folder / 'trained'}",
    )  # fmt: skip
    return folder / "trained" / "checkpoints" / "last" / "pretrained_model"


def run(module: str, *options: str) -> None:
    """One of LeRobot's programs as it is, as a process."""
    command = [sys.executable, "-m", module, *options]
    result = subprocess.run(command, env=PROCESS, capture_output=True, text=True, timeout=500)
    assert result.returncode == 0, result.stderr[-4000:]


def evaluate(output: Path, *policy: str) -> dict:
    """Outcome of every episode, by lerobot-eval."""
    run(
        "lerobot.scripts.lerobot_eval", *policy, "--policy.device=cpu", "--env.type=metaworld_rgbd", f"--env.task={TASK}",
        f"--env.cameras={CAMERAS}", f"--env.image_size={SIZE}", f"--eval.n_episodes={EPISODES}", "--eval.batch_size=1",
        "--eval.use_async_envs=false", f"--seed={SEED}", f"--output_dir={output}",
    )  # fmt: skip
    info = json.loads((output / "eval_info.json").read_text())
    return info["per_task"][0]["metrics"]


def evaluate_locally(checkpoint: Path) -> dict:
    """The same by LeRobot's own loop around the local policy. Its noise is torch's: what is drawn after the seed."""
    loaded = load_policy(checkpoint)
    environment = MetaworldRgbdEnv(task=TASK, cameras=CAMERAS, image_size=SIZE)
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


def test_a_policy_succeeds_through_a_server_where_it_does_locally(tmp_path):
    """On the same seeds, to the last bit of the reward."""
    checkpoint = train(tmp_path)
    local = evaluate_locally(checkpoint)
    with serving(real_server(load_policy(checkpoint), (1,))) as running:
        remote = ["--policy.type=pi05_geometry_remote", f"--policy.server={running.url}", "--policy.noise=client"]
        served = evaluate(tmp_path / "served", *remote)
    print(f"local  {local['successes']}\nserved {served['successes']}")  # noqa: T201
    assert sum(local["successes"]) > 0
    assert len(set(local["sum_rewards"])) == EPISODES
    assert {name: served[name] for name in OUTCOMES} == local
