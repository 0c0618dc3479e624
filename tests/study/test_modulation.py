"""One-shot feature modulation: what is trained, what stays, and that it can be folded into the projector."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy
from lerobot_policy_pi05_geometry.model.vision import Projector
from lerobot_policy_pi05_geometry.study.modulation import ModulatedProjector, adapt
from tests.datasets import ACTION_DIM, FPS, REPO_ID, write_dataset
from tests.model.helpers import randomise

PROJECTOR = "model.paligemma_with_expert.paligemma.model.multi_modal_projector.linear."


@given(seed=st.integers(0, 2**32 - 1))
def test_folding_changes_no_token(seed):
    generator = torch.Generator().manual_seed(seed)
    modulated = ModulatedProjector(Projector(6, 5))
    with torch.no_grad():
        for parameter in modulated.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    features = torch.randn(2, 3, 6, generator=generator)
    with torch.no_grad():
        expected = modulated(features)
        plain = modulated.projector(features)
        by_hand = (1 + modulated.gamma) * plain + modulated.beta
        torch.testing.assert_close(expected, by_hand)
        torch.testing.assert_close(modulated.fold()(features), expected, atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory) -> LeRobotDataset:
    root = write_dataset(tmp_path_factory.mktemp("data") / "one", lengths=(6,))
    return LeRobotDataset(REPO_ID, root=root, delta_timestamps={"action": [step / FPS for step in range(4)]})


def test_only_the_projector_changes_by_one_factor_for_each_output(demonstration):
    torch.manual_seed(0)
    config = PI05GeometryConfig(
        paligemma_variant="tiny",
        action_expert_variant="tiny",
        geometry_source="none",
        image_resolution=(28, 28),
        chunk_size=4,
        n_action_steps=4,
        max_action_dim=ACTION_DIM,
        freeze_vision_encoder=True,
        flow_samples=8,
        device="cpu",
        push_to_hub=False,
    )
    policy = make_policy(config, ds_meta=demonstration.meta)
    loaded = LoadedPolicy(policy, *make_pre_post_processors(policy.config, dataset_stats=demonstration.meta.stats))
    with torch.no_grad():
        randomise(policy, 0)  # in a new network the adaRMS gates are zero, and no gradient reaches the images
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    trainable = {name: parameter.requires_grad for name, parameter in policy.named_parameters()}
    adapt(loaded, demonstration, steps=3, batch_size=4, seed=0)
    after = policy.state_dict()
    assert after.keys() == before.keys()
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    assert changed == {f"{PROJECTOR}weight", f"{PROJECTOR}bias", "progress.step"}
    assert {name: parameter.requires_grad for name, parameter in policy.named_parameters()} == trainable
    assert not policy.training
    ratio = after[f"{PROJECTOR}weight"] / before[f"{PROJECTOR}weight"]
    torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio), atol=1e-4, rtol=1e-4)  # one factor for each output
